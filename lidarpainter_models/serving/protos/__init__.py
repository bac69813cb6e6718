"""Messages of the simulators' interface, generated from the .proto files beside this module.

They are written anew in the root of the repository by `python -m grpc_tools.protoc -I .
--python_out=. --pyi_out=.` and the paths of both .proto files.
"""
