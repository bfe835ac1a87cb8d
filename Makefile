# Two commands on a fresh machine: `make demo` and `make test`. Everything lands in .venv and out/; `make help` lists all.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
PYTEST := ROS_PYTHON_CHECK_FIELDS=1 $(BIN)/python -m pytest

.PHONY: help demo test test-accuracy test-slow test-live test-gpu mutation fuzz lint types count docs wheel-check wheel-oldest \
  wheel-newest colcon-check install install-nets install-test clean
.DELETE_ON_ERROR:

help:  ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "%-14s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: install  ## replay bags/demo through the five-node graph, print errors, write bag, overlay and report
	$(BIN)/hat replay bags/demo --out out/demo --overwrite

test: lint types  ## lint, types and the whole suite, accuracy gate included; at most 12 minutes on two cores
	$(PYTEST) -m "not slow and not gpu"

test-accuracy: install-test  ## the accuracy gate alone: the default preset on seeded clips
	$(PYTEST) test/accuracy

test-slow: install-test  ## tests that take minutes each
	$(PYTEST) -m "slow and not gpu"

test-live: install-test  ## every scenario of the live graph: kills, lifecycle orders, cameras; minutes
	$(PYTEST) -m live

test-gpu: install-test  ## tests that need an accelerator
	$(PYTEST) -m gpu

mutation: install-test  ## does the accuracy gate see changed constants? stage by stage, an hour
	$(BIN)/python tools/mutate.py

fuzz: install-test  ## changed inputs: HAT_FUZZ_CASES=10000 per reader, a fiftieth through track, HAT_FUZZ_SEED=1
	HAT_FUZZ_CASES=$${HAT_FUZZ_CASES:-10000} $(PYTEST) -s test/fuzz

lint: install-test  ## ruff: rules and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install-test  ## mypy over the package
	$(BIN)/mypy

count: install  ## rooms, arrows, lines, constants and keys of what the default preset imports
	$(BIN)/python tools/count.py

docs: $(VENV)/.docs  ## the site of docs/ into build/site; a warning fails
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

wheel-check: install  ## sdist, wheel, empty environment with the pinned versions: track and replay a clip
	PYTHON=$(PYTHON) tools/check_wheel.sh pinned

wheel-oldest: install  ## the same with every lower bound of pyproject.toml (PYTHON=python3.11)
	PYTHON=$(PYTHON) tools/check_wheel.sh oldest

wheel-newest: install  ## the same with the newest releases: a report, never fails
	PYTHON=$(PYTHON) timeout 1500 tools/check_wheel.sh newest || echo "REPORT: the newest versions gave no answer in time"

colcon-check:  ## colcon build with the versions of Ubuntu 24.04's apt, then track a clip from the install space
	PYTHON=$(PYTHON) tools/check_colcon.sh

install: $(VENV)/.base  ## .venv with what runs: pinned, ROS as wheels, no torch
install-nets: $(VENV)/.nets  ## and torch with what the learned backends need
install-test: $(VENV)/.test  ## and the tools of lint, types and tests

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || \
	  { echo "hat_ros needs Python 3.11 to 3.13; choose one with: make PYTHON=python3.12 ..." >&2; exit 2; }
	@$(PYTHON) -m venv $(VENV) || \
	  { rm -rf $(VENV); echo "creating .venv failed: on Debian and Ubuntu, apt install python3-venv" >&2; exit 2; }

# Without dependencies of their own, then checked: a package that is not pinned cannot slip in. torch is the exception,
# since what it needs differs between its builds.
$(VENV)/.base: requirements.txt pyproject.toml setup.py | $(VENV)/bin/python
	$(PIP) --no-deps -r requirements.txt
	$(PIP) --no-deps --no-build-isolation -e .
	$(BIN)/python -m pip check --disable-pip-version-check
	@touch $@

$(VENV)/.nets: $(VENV)/.base requirements-nets.txt
	$(PIP) -r requirements-nets.txt
	@touch $@

$(VENV)/.test: $(VENV)/.nets requirements-test.txt
	$(PIP) --no-deps -r requirements-test.txt
	$(BIN)/python -m pip check --disable-pip-version-check
	@touch $@

$(VENV)/.docs: $(VENV)/.base requirements-docs.txt
	$(PIP) --no-deps -r requirements-docs.txt
	$(BIN)/python -m pip check --disable-pip-version-check
	@touch $@

clean:  ## remove .venv and everything made
	rm -rf $(VENV) out build install log
