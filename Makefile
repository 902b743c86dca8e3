# Everything happens in .venv, made from the locked requirements. `make demo` and `make test` are all
# that a newcomer needs.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
PEERS := $(VENV)/.peers
PYRTC := $(VENV)/pyrtc
FUZZ_S ?= 120
SEED ?= 1
COUNT ?= 200
SOAK_S ?= 3600
HOURS ?= 1
SOURCES := benchmarks docs fitctl fuzz tests  # not what somebody tries out in the checkout
FAULT_RESULTS ?= .fault-results.json
MISWIRED_RESULTS ?= .miswired-results.json
# Two instruments side by side: one takes less than half a core.
FAULTS := tests/faults --numprocesses 2 --dist loadgroup

# Compiled anew by every process, the code costs each worker and each fitctl that a test starts seconds.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: $(shell sed -n 's/^\([a-z-]*\):.*/\1/p' $(MAKEFILE_LIST))

help:  ## List the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 22

setup: $(READY)  ## Make .venv from the locked requirements

# A new pip, without resolving and compiling as it goes, needs half the time of the one that came with Python 3.11.
$(READY): requirements/pip.lock requirements/dev.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "fitctl needs Python 3.11 or newer; set PYTHON=python3.x")'
	@echo "Setting up $(VENV) (about a minute, once) ..."
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/pip.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-compile --require-hashes -r requirements/dev.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@$(BIN)/python -m compileall -qq -j 0 $(VENV)/lib || true  # a package may have files for other Pythons
	@touch $(READY)

demo: $(READY)  ## Run the whole instrument on mock devices
	@$(BIN)/fitctl demo $(ARGS)

BESIDE := $(MAKE) --no-print-directory --jobs 2 --output-sync=target

test: lint contract  ## Run lint, import contract, types, and all tests without a target of their own
	@echo "Types and tests, about five minutes on two cores ..."
	@$(BESIDE) types warm
	@$(MAKE) --no-print-directory test-parts

# Workers that begin at once would each compile all tests. What fails here is printed by the tests themselves.
warm: $(READY)
	@for half in 'tests/[a-l]*/' 'tests/[m-z]*/ tests/*.py'; do \
	    $(BIN)/pytest --collect-only --quiet --ignore tests/system $$half > /dev/null & \
	done; wait

lint: $(READY)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)

types: $(READY)
	$(BIN)/pyrefly check

contract: $(READY)
	$(BIN)/lint-imports

pytest: $(READY)
ifdef ARGS
	$(BIN)/pytest $(ARGS)
else
	@$(MAKE) --no-print-directory test-parts test-instrument
endif

# Many tests wait for a time limit: four workers on two cores.
test-parts: $(READY)
	$(BIN)/pytest --numprocesses 4 --dist loadfile --ignore tests/system

# Nothing may run beside it: it judges real time. Two demos beside a third instrument take more than two cores have.
test-instrument: $(READY)  ## Test the whole instrument in real time, as processes on real wires
	$(BIN)/pytest --numprocesses 2 --dist loadfile --ignore tests/system/alone tests/system
	$(BIN)/pytest tests/system/alone

test-long: compiled  ## Run batches, campaigns, whole nights, the commands of the documents: all that takes seconds (20 minutes)
	$(BIN)/pytest -m long --numprocesses 3 --dist loadfile $(ARGS)

# Each takes a minute of one core, and a test that waits for it may not be done in time.
compiled: $(READY)
	@echo "Compiling the batch ..."
	@for rig in fit-mock fit-testbed; do \
	    $(BIN)/fitctl simulate --rig rigs/$$rig.toml --runs 2 --duration 1 --json > /dev/null & \
	done; wait

test-slow: $(READY)  ## Run the acceptance tests: ten demos of a minute each, ten long simulations
	$(BIN)/pytest -m slow --timeout 1800 $(ARGS)

test-console: $(READY)  ## Test the tutorial as typed, and the console by keys (tmux) and in a browser (Chromium)
	-@tests/install-packages tmux chromium
	$(BIN)/pytest -m terminal tests/system --numprocesses 2 --dist worksteal $(ARGS)

test-faults: $(READY)  ## Run the fault catalogue on the instrument, in real time
	$(BIN)/pytest -m "fault and not testbed" $(FAULTS) $(ARGS)

test-faults-all: $(READY)
	$(BIN)/pytest -m fault $(FAULTS) $(ARGS)

# As much as fits into continuous integration; with the PART_SEED that it prints, a run is repeated.
PART_SEED := $(or $(PART_SEED),$(shell od -An -N2 -tu2 /dev/urandom | tr -d ' '))
test-long-part: export FITCTL_TESTS_PART = 45
test-instrument-part: export FITCTL_TESTS_PART = 10
test-faults-part: export FITCTL_TESTS_PART = 20
%-part: export FITCTL_TESTS_SEED = $(PART_SEED)
test-long-part: test-long  ## Run 45 of the tests of test-long, drawn at random
test-instrument-part: test-instrument  ## Run 10 tests of test-instrument, drawn at random, and those that must run alone
test-faults-part: test-faults-all  ## Run 20 entries of the whole fault catalogue, drawn at random

test-faults-testbed: $(READY)  ## Run the fault catalogue's entries for the whole testbed
	$(BIN)/pytest -m "fault and testbed" $(FAULTS) $(ARGS)

reliability: $(READY)  ## Run the fault catalogue and write its results into docs/fault-catalogue.md
	FITCTL_FAULT_RESULTS=$(FAULT_RESULTS) $(BIN)/pytest -m fault $(FAULTS) $(ARGS)
	cd tests && ../$(BIN)/python -m faults.report ../$(FAULT_RESULTS)

test-miswired: $(READY)  ## Commission rigs that are wired wrongly, and write the results into docs/commissioning.md
	FITCTL_MISWIRED_RESULTS=$(CURDIR)/$(MISWIRED_RESULTS) $(BIN)/pytest -m miswired tests/miswired --numprocesses 2 $(ARGS)
	cd tests && ../$(BIN)/python -m miswired.report ../$(MISWIRED_RESULTS)

test-peers: $(PEERS)  ## Run other people's programs against the mocks, and the drivers against theirs
	$(BIN)/pytest -m peer tests/peers $(ARGS)

$(PEERS): $(READY) requirements/peers.lock tests/install-packages tests/peers/install tests/peers/canopen/package-lock.json tests/peers/mcap/package-lock.json
	@echo "Getting the peers ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/peers.lock
	@if tests/peers/install; then touch $(PEERS); fi  # what is missing is tried again the next time

fuzz: $(READY)  ## Fuzz every parser with coverage guidance, FUZZ_S seconds each (needs atheris)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/fuzz.lock
	@for target in fuzz/fuzz_*.py; do $(BIN)/python $$target -max_total_time=$(FUZZ_S) || exit 1; done

mutants: $(READY)  ## Run mutation testing: COUNT changes to the code drawn by SEED, and which of them the tests find
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/mutants.lock
	$(BIN)/python -m benchmarks.mutants --seed $(SEED) --count $(COUNT) $(ARGS)

swarm: $(READY)  ## Run HOURS hours on virtual time from SEED with all kinds of faults, and check what must hold
	nice -n 19 $(BIN)/python -m benchmarks.swarm --hours $(HOURS) $(if $(filter-out file,$(origin SEED)),--seed $(SEED)) $(ARGS)

soak: $(READY)  ## Run SOAK_S seconds on mocks with random faults, and report growth, delays and losses
	$(BIN)/python -m benchmarks.soak --duration $(SOAK_S) $(ARGS)

bench-sim: $(READY)  ## Measure the speed of the simulation and the batch, relative to real time
	$(BIN)/python -m benchmarks.simulate $(ARGS)

bench-learn: $(READY)  ## Measure learnt designs on nights that differ from the rig file (five minutes)
	$(BIN)/python -m benchmarks.learn $(ARGS)

bench-learn-online: $(READY)  ## Measure loops that learn while they observe (half an hour)
	$(BIN)/python -m benchmarks.learn_online $(ARGS)

bench-margins: $(READY)  ## Compute the least residual that the margins allow, beside the learner's design (two minutes)
	$(BIN)/python -m benchmarks.least_with_margins $(ARGS)

bench-sensor: $(READY)  ## Measure the time that the fit of a spot takes, beside the centroid
	$(BIN)/python -m benchmarks.sensor $(ARGS)

bench-testbed: $(READY)  ## Measure the testbed while its collector moves, and compare with its goals (ten minutes)
	$(BIN)/python -m benchmarks.testbed $(ARGS)

bench-report: $(READY)  ## Measure time and memory of the report of an eight-hour night
	$(BIN)/python -m benchmarks.report $(ARGS)

bench-recorder: $(READY)  ## Measure the recorder at 500 ticks and frames a second
	$(BIN)/python -m benchmarks.recorder $(ARGS)

bench-flood: $(READY)  ## Measure the tick with and without a flood of messages to the service
	$(BIN)/python -m benchmarks.flood $(ARGS)

bench-console: $(READY)  ## Measure the cost of a console, and its effect on the loop
	$(BIN)/python -m benchmarks.console $(ARGS)

bench-devices: $(READY)  ## Measure round trips of the mocks, the CAN servo cycle, three servos, the camera's stream
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/bench.lock
	$(BIN)/python -m benchmarks.roundtrips
	$(BIN)/python -m benchmarks.can
	$(BIN)/python -m benchmarks.servos
	$(BIN)/python -m benchmarks.gvsp

bench-loop: $(READY) $(PYRTC)/.ready  ## Measure from the last packet to the D/A at 50 to 2000 Hz, beside pyRTC and C (8 minutes)
	@tests/install-packages rt-tests
	@$(CC) -O2 -Wall -Wextra -o $(VENV)/loop-floor benchmarks/loop/floor.c
	$(BIN)/python -m benchmarks.loop --floor $(VENV)/loop-floor --pyrtc $(PYRTC)/bin/python \
	    --pyrtc-example $(PYRTC)/source/examples/synthetic_shwfs $(ARGS)

# An environment of its own: pyRTC's package brings a module `benchmarks` too. Its example is in the source alone.
$(PYRTC)/.ready: requirements/pyrtc.lock | $(READY)
	@echo "Getting pyRTC ..."
	@rm -rf $(PYRTC)
	@$(PYTHON) -m venv $(PYRTC)
	@$(PYRTC)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/pyrtc.lock
	@sed -n '/^pyrtcao==/,/[^\\]$$/p' requirements/pyrtc.lock > $(PYRTC)/source.txt
	@$(PYRTC)/bin/python -m pip download --quiet --disable-pip-version-check --no-deps --no-binary pyrtcao --require-hashes -r $(PYRTC)/source.txt -d $(PYRTC)
	@mkdir $(PYRTC)/source
	@tar -xzf $(PYRTC)/pyrtcao-*.tar.gz --strip-components 1 -C $(PYRTC)/source
	@touch $@

docs: $(READY)  ## Build the documentation as a site, dist/docs/index.html (needs npm)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/docs.lock
	@npm --prefix requirements/site ci --silent --no-audit --no-fund
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo "dist/docs/index.html"

pictures: $(READY)  ## Draw the schematics of the documents, docs/pictures/*.svg
	@$(BIN)/python docs/pictures/draw.py

moving-picture: $(READY)  ## Record the console for the README, docs/pictures/console-moving.gif (needs Chromium)
	@$(BIN)/python docs/pictures/take_moving.py

dist: $(READY)  ## Build wheel and sdist, into dist/
	$(BIN)/python -m hatchling build -d dist

release-check: $(READY)  ## Install wheel and sdist on every Python from 3.11 on, and run demo and tutorial (RELEASING.md)
	$(BIN)/pytest -m dist tests/dist $(ARGS)

LOCK := --universal --python-version 3.11 --generate-hashes --no-annotate --no-emit-index-url \
    --custom-compile-command "make lock" --quiet

lock: $(READY)  ## Resolve the requirements again (needs uv and npm)
	uv pip compile pyproject.toml --extra fast --extra cluster --extra parquet --extra web --group dev $(LOCK) -o requirements/dev.lock
	uv pip compile --group pip $(LOCK) -o requirements/pip.lock
	uv pip compile --group peers $(LOCK) --constraint requirements/dev.lock -o requirements/peers.lock
	uv pip compile --group fuzz $(LOCK) --constraint requirements/dev.lock -o requirements/fuzz.lock
	uv pip compile --group docs $(LOCK) --constraint requirements/dev.lock -o requirements/docs.lock
	uv pip compile --group bench $(LOCK) --constraint requirements/dev.lock -o requirements/bench.lock
	uv pip compile --group mutants $(LOCK) --constraint requirements/dev.lock -o requirements/mutants.lock
	uv pip compile --group pyrtc $(LOCK) --constraint requirements/dev.lock -o requirements/pyrtc.lock
	npm --prefix requirements/site install --package-lock-only --omit-lockfile-registry-resolved --silent

clean:  ## Remove .venv and caches
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find fitctl tests benchmarks -name __pycache__ -prune -exec rm -rf {} +
