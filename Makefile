# Two commands on a fresh machine: `make demo` and `make test`. Everything lands in .venv and out/.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test test-slow test-gpu lint install install-nets clean
.DELETE_ON_ERROR:

demo: install  ## replay bags/demo through the five-node graph, print errors, write bag, overlay and report
	$(BIN)/hat replay bags/demo --out out/demo --overwrite

test: install-nets  ## lint and the whole suite
	$(BIN)/ruff check hat_ros test launch setup.py
	$(BIN)/ruff format --check hat_ros test launch setup.py
	ROS_PYTHON_CHECK_FIELDS=1 $(BIN)/python -m pytest -m "not slow and not gpu"

test-slow: install-nets
	ROS_PYTHON_CHECK_FIELDS=1 $(BIN)/python -m pytest -m "slow and not gpu"

test-gpu: install-nets
	ROS_PYTHON_CHECK_FIELDS=1 $(BIN)/python -m pytest -m gpu

lint: install-nets
	$(BIN)/ruff check hat_ros test launch setup.py
	$(BIN)/ruff format --check hat_ros test launch setup.py

install: $(VENV)/.base
install-nets: $(VENV)/.nets

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' || \
	  { echo "hat_ros needs Python 3.10 to 3.13; choose one with: make PYTHON=python3.12 ..." >&2; exit 2; }
	@$(PYTHON) -m venv $(VENV) || \
	  { rm -rf $(VENV); echo "creating .venv failed: on Debian and Ubuntu, apt install python3-venv" >&2; exit 2; }

$(VENV)/.base: requirements.txt setup.py | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

$(VENV)/.nets: $(VENV)/.base requirements-test.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-test.txt
	@touch $@

clean:
	rm -rf $(VENV) out build install log
