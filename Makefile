# Two commands do everything on a fresh machine: `make demo` and `make test`.

PYTHON ?= python3
VENV ?= .venv
# Processes that share the tests, beside that of `test-jazzy`: more than cores, as tests of nodes wait
# for most of their time. Each takes some 8 s of processor time to begin.
WORKERS ?= 4
# Python 3.12 for `make test-jazzy`: the first of these that runs.
PYTHON_JAZZY ?= $(firstword $(foreach python,python3.12 $(wildcard $(HOME)/.pyenv/versions/3.12.*/bin/python),\
    $(shell $(python) -c 'import ensurepip, venv' 2>/dev/null && echo $(python))))
VENV_JAZZY ?= .venv-jazzy

BIN := $(VENV)/bin
# A compat install puts a plain path into site-packages, which type checkers can follow.
BUILD := --no-build-isolation --config-settings editable_mode=compat
INSTALL = $(BIN)/python test/uv_install.py --python

# Another ROS installation that the shell has sourced must not shadow the environment's packages.
unexport PYTHONPATH AMENT_PREFIX_PATH LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
# Containers often set it: every process would compile all its modules, torch alone for 1.2 s.
unexport PYTHONDONTWRITEBYTECODE

# Recordings with known truth, and which stored measurements are made again.
DATA ?= ../recordings
ONLY ?= *

version := $(shell $(PYTHON) -c 'import platform; print(platform.python_version())')
installer := $(VENV)/.installer-$(version)
runtime := $(VENV)/.runtime-$(version)
tests := $(VENV)/.tests-$(version)
consumers := .venv-consumers/.done-$(version)
jazzy := $(VENV_JAZZY)/.done

# What depends on the versions of Python, numpy, SciPy, PyYAML or pytest: kernels by their known
# answers, readers and writers, arrays of messages, splines, and two recordings taken all the way. On
# none of them depend the accuracy of boxes, the order of input and what is said of it, and torch.
JAZZY_TESTS := test/test_config.py test/msg_adapters test/labels/test_labels.py \
    $(patsubst %,test/core/test_%.py, faces field_of_view follow geometry input_model input_statistics \
        l_shape matching metrics observation point_labels problem solver voxels) \
    test/core/test_method.py::test_value_gradient_and_curvature_are_those_of_automatic_differentiation \
    $(patsubst %,test/io/test_%.py, definitions foxglove id_assignment item_source lidars \
        message_contents recording schemas session transforms valid_files whole_files) \
    test/offline/test_evaluate.py test/measure/test_baselines.py \
    test/offline/test_relabel.py::test_every_box_is_written_once_in_order \
    test/offline/test_relabel.py::test_refined_boxes_match_the_truth_in_the_fixed_frame

# Each worker begins with one end of the suite and takes tests of the other when it is done.
SHARED := -n $(WORKERS) --dist worksteal

.PHONY: help demo test environments compiled jazzy-beside test-main coverage checked test-jazzy lint format docs results figures clean

help: ## list the commands
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-12s %s\n", $$1, $$2}' $(firstword $(MAKEFILE_LIST))

demo: $(runtime) ## set up, refine the sample recording and complete its tracks, print accuracy before and after
	$(BIN)/boxreg relabel bags/street.mcap -o out/demo --complete --report
	@echo; echo 'Before:'
	$(BIN)/boxreg evaluate bags/street.mcap bags/street_truth.csv
	@echo; echo 'After:'
	$(BIN)/boxreg evaluate out/demo/boxes.csv bags/street_truth.csv
	@echo; echo 'Refined boxes: out/demo/boxes.csv    What was done, to look at: out/demo/report.html'

# Download, unpacking and compilation do not depend on each other: they share the cores.
test: ## set up, run the whole suite, and a part of it as on Ubuntu 24.04
	@$(MAKE) --no-print-directory --jobs test-main jazzy-beside
	@cat out/jazzy.txt
	@! grep -q '^NOT PASSED' out/jazzy.txt

environments: $(tests) $(consumers) $(if $(PYTHON_JAZZY),$(jazzy)) ## set up all that tests need, in parallel with --jobs

compiled: $(runtime)
	$(BIN)/python test/warmed.py

# It is one more process beside those of the other tests, and prints nothing among theirs. What it
# compiles is apart: tests copy the sources with all that is beside them.
jazzy-beside: $(if $(PYTHON_JAZZY),$(jazzy))
	@mkdir -p out
	@export PYTHONPYCACHEPREFIX=$(CURDIR)/$(VENV_JAZZY)/pycache NUMBA_CACHE_DIR=$(CURDIR)/$(VENV_JAZZY)/kernels; \
	{ \
	    $(MAKE) --no-print-directory test-jazzy \
	    || echo 'NOT PASSED: the tests with the versions of Ubuntu 24.04'; \
	} > out/jazzy.txt 2>&1

test-main: compiled $(tests) $(consumers)
	$(BIN)/python -m pytest $(SHARED)

coverage: $(tests) $(consumers) ## run the suite and print the part of the lines that it executes
	$(BIN)/python -m pytest $(SHARED) --cov --cov-report=term:skip-covered

# `kernel` says why: an index that is negative or too large would read or damage other memory.
checked: $(tests) ## run the tests of the core with each index of each kernel checked
	NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR=$(CURDIR)/out/checked $(BIN)/python -m pytest $(SHARED) \
	    --ignore test/core/test_kernel_cache.py test/core test/tracks test/test_parity.py \
	    test/test_image.py::test_the_first_fit_has_no_residual_of_variables_that_it_lacks

test-jazzy: $(if $(PYTHON_JAZZY),$(jazzy)) ## run a part of the suite with the versions of Ubuntu 24.04
	@[ -n '$(PYTHON_JAZZY)' ] || { \
	    echo 'NOT RUN: the tests with the versions of Ubuntu 24.04 need Python 3.12, and none was found.'; \
	    echo 'Install it, or name it: make test-jazzy PYTHON_JAZZY=/path/to/python3.12'; }
	$(if $(PYTHON_JAZZY),$(VENV_JAZZY)/bin/python -m pytest -q -n 0 --durations=3 \
	    -W error::FutureWarning $(JAZZY_TESTS))

lint: $(tests) ## run the linters alone
	$(BIN)/python -m pytest test/test_lint.py

format: $(tests) ## sort imports, fix what ruff can fix, format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(tests) ## write the generated pages and build the documentation into out/site
	$(BIN)/python docs/generate.py
	$(BIN)/python docs/results.py
	PYTHONPATH=test $(BIN)/python test/live/test_share.py
	$(BIN)/mkdocs build --strict --quiet --site-dir out/site

results: $(tests) ## measure again as docs/results/$(ONLY).json say, with recordings in DATA (hours)
	$(BIN)/python test/measure renew $(DATA) --only '$(ONLY)'
	$(BIN)/python docs/results.py

figures: $(tests) ## draw every picture again from runs of this machine (some minutes)
	PYTHONPATH=test $(BIN)/python docs/figures.py

clean: ## remove environments and whatever builds and runs left
	rm -rf $(VENV) $(VENV_JAZZY) .venv-consumers .venv-page build dist install log out .coverage
	find boxreg_ros msg_adapters test -name __pycache__ -prune -exec rm -rf {} +

# The only environment with pip, which takes seconds: its uv installs into all of them.
$(installer): constraints.txt
	@echo 'Setting up $(VENV): the first time takes some minutes'
	[ "$$($(BIN)/python -V 2>&1)" = 'Python $(version)' ] || $(PYTHON) -m venv --clear $(VENV)
	$(INSTALL) $(VENV) -c constraints.txt setuptools
	@touch $@

$(runtime): $(installer) setup.py package.xml
	$(INSTALL) $(VENV) -c constraints.txt $(BUILD) -e '.[ros,report,tracking]'
	@touch $@

$(tests): $(runtime) $(shell find test/interfaces msg_adapters/interfaces test/build_interfaces.py -type f)
	$(INSTALL) $(VENV) -c constraints.txt $(BUILD) -e '.[ros,report,tracking,test]'
	$(BIN)/python test/build_interfaces.py
	@touch $@

$(consumers): test/consumers.txt | $(installer)
	$(PYTHON) -m venv --clear --without-pip .venv-consumers
	$(INSTALL) .venv-consumers --no-deps -r $<
	@touch $@

$(jazzy): constraints.txt constraints-jazzy.txt setup.py package.xml | $(installer)
	@echo 'Setting up $(VENV_JAZZY) with $(PYTHON_JAZZY)'
	$(PYTHON_JAZZY) -m venv --clear --without-pip $(VENV_JAZZY)
	awk -F '==' '{name = tolower($$1)} FNR == NR {own[name]} FNR == NR || !(name in own)' \
	    constraints-jazzy.txt constraints.txt > $(VENV_JAZZY)/constraints.txt
	$(INSTALL) $(VENV_JAZZY) -c $(VENV_JAZZY)/constraints.txt setuptools
	printf '%s\n' triton cuda-bindings > $(VENV_JAZZY)/excluded.txt  # of torch: .7 GB for GPUs
	$(INSTALL) $(VENV_JAZZY) -c $(VENV_JAZZY)/constraints.txt --excludes $(VENV_JAZZY)/excluded.txt \
	    $(BUILD) -e '.[ros,report]' pytest pytest-xdist shapely
	@touch $@
