# Everything happens in .venv, made from the locked requirements. `make demo` and `make test` are all
# that a newcomer needs.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.DEFAULT_GOAL := help
.PHONY: help setup demo test lint types contract pytest test-slow bench-sim lock clean

help:  ## Say what can be made
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

setup: $(READY)  ## Make .venv from the locked requirements

$(READY): requirements/dev.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "fitctl needs Python 3.11 or newer; set PYTHON=python3.x")'
	@echo "Setting up $(VENV) (about a minute, once) ..."
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/dev.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $(READY)

demo: $(READY)  ## Run the whole instrument on mock devices
	@$(BIN)/fitctl demo $(ARGS)

test: lint types contract pytest  ## Lint, types, import contract, tests

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy

contract: $(READY)
	$(BIN)/lint-imports

pytest: $(READY)
	$(BIN)/pytest $(ARGS)

test-slow: $(READY)  ## The acceptance runs: ten demos of a minute each, ten long simulations
	$(BIN)/pytest -m slow --timeout 1800 $(ARGS)

bench-sim: $(READY)  ## How many times real time the simulation and the batch run
	$(BIN)/python -m benchmarks.simulate $(ARGS)

lock: $(READY)  ## Resolve the requirements anew (needs uv)
	uv pip compile pyproject.toml --extra fast --extra cluster --group dev --universal --python-version 3.11 \
	    --generate-hashes --no-annotate --custom-compile-command "make lock" --quiet -o requirements/dev.lock

clean:  ## Remove .venv and caches
	rm -rf $(VENV) .mypy_cache .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find fitctl tests benchmarks -name __pycache__ -prune -exec rm -rf {} +
