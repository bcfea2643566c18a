# make demo: silhouettes of examples/ become stacks in out/demo.    make test: linter, types, fast tests.
# make studio: a page opens on which drawings become structures.
# All set up .venv first, once: again only after setup.cfg, pyproject.toml or constraints.txt change.

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# The first CPython 3.11 to 3.13 that runs; 3.11 first, which has PyBullet too. Or: make PYTHON=/path/to/python3.12
fits := import sys; sys.exit(sys.implementation.name != "cpython" or not (3, 11) <= sys.version_info[:2] <= (3, 13))
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3 python; do \
	$$p -c '$(fits)' 2>/dev/null && echo $$p && break; done)
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2

.PHONY: demo studio test test-all lint setup clean

demo: $(STAMP)
	$(BIN)/stackgen sample examples/silhouettes/* --num_samples 3 --out out/demo

studio: $(STAMP)
	$(BIN)/stackgen studio --open

test: lint
	$(PYTEST) -m "not slow"

test-all: lint
	$(PYTEST)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

setup: $(STAMP)

$(STAMP): setup.cfg pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "stackgen needs CPython 3.11 to 3.13: install one, or make PYTHON=/path/to/python3.12" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	@# torch first and pinned: what comes after then finds it there and pulls nothing else in.
	$(BIN)/python -m pip install --quiet -c constraints.txt torch
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[dev]"
	@touch $@

clean:
	rm -rf $(VENV) out .mypy_cache .ruff_cache .pytest_cache
