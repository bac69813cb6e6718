"""The run-time checker that the tests put around the library."""

from beartype import BeartypeConf, beartype

# an int may stand for a float, as PEP 484 says
check = beartype(conf=BeartypeConf(is_pep484_tower=True))
