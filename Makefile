# Everything runs in .venv, which the first target that needs it makes.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: install demo sweep-tiny test test-slow test-slurm lint fmt types arch check bench

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12) and "Python 3.11 or 3.12 is needed, this is " + sys.version.split()[0] + "; say make PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

demo: install
	PATH="$(CURDIR)/$(BIN):$$PATH" bash demo/run.sh

# The paper's ablations on synthetic rooms; two hours on two cores, and resumable.
sweep-tiny: install
	PATH="$(CURDIR)/$(BIN):$$PATH" bash demo/sweeps.sh

# JOBS processes share the tests out by files. One thread each: several on too few cores wait for
# each other far longer than they work.
JOBS ?= 2
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest

test: install
	$(PYTEST) --numprocesses $(JOBS) --dist loadfile

test-slow: install
	$(PYTEST) --numprocesses $(JOBS) --dist worksteal -m "slow and not gpu and not slurm"

# On a real SLURM of two nodes, which it starts and ends; docs/cluster.md says what it needs.
test-slurm: install
	$(BIN)/python -m pytest -m slurm -v tests/slurm

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

fmt: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: install
	$(BIN)/mypy

arch: install
	$(BIN)/lint-imports

check: lint types arch

bench: install
	$(BIN)/python -m benchmarks.run
