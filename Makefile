# `make demo` and `make test` do all the set-up on a fresh machine.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
SYSTEM := $(VENV)/.system-libraries
DOCUMENTERS := $(VENV)/.documenters
FIGURES := $(BIN)/lidarpainter --store figures-store

# spinning OpenMP threads turn shared cores into many times the CPU time
export OMP_WAIT_POLICY := passive

.PHONY: demo test lint nightly bench docs figures gpu-check clean

demo: $(INSTALLED) $(SYSTEM)
	$(BIN)/lidarpainter demo --out demo

# two processes: half of the tests' time is waiting for what they start
test: lint
	$(BIN)/python -m pytest -n 2

# what takes too long for every change: runs killed and resumed, thousands of damaged logs
nightly: $(INSTALLED) $(SYSTEM)
	$(BIN)/python -m pytest -m slow -n 2

lint: $(INSTALLED) $(SYSTEM)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy

bench: $(INSTALLED)
	PYTHONPATH=tests/support $(BIN)/python tests/benchmarks/suite.py

# the site of the documentation: docs/_site/index.html; a warning is an error, links are checked
docs: $(DOCUMENTERS)
	$(BIN)/sphinx-build --fail-on-warning --keep-going --fresh-env -q docs docs/_site

# the tables of README and docs from runs of this code, hours where there are none yet. PANDASET is
# the data set as downloaded, STRANGERS a folder of logs in canonical form, WEIGHTS SqueezeNet's;
# without them their tables stay as they are
figures: $(INSTALLED) $(SYSTEM)
	$(if $(PANDASET),$(FIGURES) ingest pandaset $(PANDASET) 002 --frames 0:28)
	$(if $(STRANGERS),$(FIGURES) ingest canonical $(STRANGERS)/kitti drive_0005)
	$(if $(STRANGERS),$(FIGURES) ingest canonical $(STRANGERS)/aimotive night)
	$(BIN)/python scripts/street_logs.py figures-store
	$(FIGURES) figures docs/figures.toml $(if $(WEIGHTS),--feature-weights $(WEIGHTS))

# five minutes on a machine with a GPU: agreement with the CPU, speed, memory; gpu-check.md
gpu-check: $(INSTALLED) $(SYSTEM)
	$(BIN)/python tests/benchmarks/gpu_check.py --out gpu-check.md

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $@

$(DOCUMENTERS): $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[docs]"
	touch $@

# open3d loads these shared libraries; apt is used where it may be
$(SYSTEM): $(INSTALLED)
	@sh scripts/system_libraries.sh $(BIN)/python
	touch $@

clean:
	rm -rf $(VENV) demo docs/_site
