# Two commands do everything on a fresh machine: `make demo` and `make test`.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
INSTALL := $(PIP) install -qq --use-pep517 --no-build-isolation -c constraints.txt

# What another ROS set-up left in the shell must not shadow the packages of the environment.
unexport PYTHONPATH AMENT_PREFIX_PATH LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE

version := $(shell $(PYTHON) -c 'import platform; print(platform.python_version())')
runtime := $(VENV)/.runtime-$(version)
tests := $(VENV)/.tests-$(version)
consumers := .venv-consumers/.done-$(version)

.PHONY: demo test lint format clean

demo: $(runtime)
	$(BIN)/boxreg relabel bags/street.mcap -o out/demo --report
	@echo; echo 'Before:'
	$(BIN)/boxreg evaluate bags/street.mcap bags/street_truth.csv
	@echo; echo 'After:'
	$(BIN)/boxreg evaluate out/demo/boxes.csv bags/street_truth.csv
	@echo; echo 'Refined boxes: out/demo/boxes.csv    What was done, to look at: out/demo/report.html'

test: $(tests) $(consumers)
	$(BIN)/python -m pytest

lint: $(tests)
	$(BIN)/python -m pytest test/test_lint.py

format: $(tests)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) .venv-consumers build install log out

$(runtime): constraints.txt setup.py package.xml
	@echo 'Setting up $(VENV): the first time takes some minutes'
	[ "$$($(BIN)/python -V 2>&1)" = 'Python $(version)' ] || $(PYTHON) -m venv --clear $(VENV)
	$(PIP) install -qq -c constraints.txt setuptools
	$(INSTALL) -e '.[ros,report]'
	@touch $@

$(tests): $(runtime) $(shell find test/interfaces test/build_interfaces.py -type f)
	$(INSTALL) -e '.[ros,report,bench,test,interfaces]'
	$(BIN)/python test/build_interfaces.py
	@touch $@

$(consumers): test/consumers.txt
	$(PYTHON) -m venv --clear .venv-consumers
	.venv-consumers/bin/python -m pip --disable-pip-version-check install -qq --no-deps -r $<
	@touch $@
