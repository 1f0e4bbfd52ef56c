# A newcomer needs `make demo` and `make test` only. Each of them sets up .venv first.
.PHONY: help demo test test-delicate test-clock test-compiling test-lowest test-lowest-files test-lowest-clock check format bench rig faults fuzz soak gallery audit pin release setup setup-dev setup-release clean
PYTHON_BIN := .venv/bin/python
ARGS ?=
# The tests start hundreds of programs. Each would compile all that it imports, which takes longer than most of the tests.
unexport PYTHONDONTWRITEBYTECODE
# Tests that drive a browser run alone, those that mostly wait for the clock three at a time, most others two files at a
# time. What runs beside them, at low priority, uses the processor time that they leave.
BROWSER := tests/browser tests/cli/test_page.py tests/gallery tests/rig/test_json.py
CLOCK := tests/ros tests/session/test_node_client.py tests/session/test_live_session.py \
	tests/planner/onboard/test_failsafe_process.py tests/planner/onboard/test_node_life.py
# Tests that compile most of the time, and watch no clock.
COMPILING := tests/planner/deploy tests/planner/kernels tests/planner/test_cpp_host.py
# A busy machine can delay a browser or a clock beyond what a test waits for: at most three of them get a second attempt.
SECOND_ATTEMPT := --reruns 1 --max-suite-reruns 3 --rerun-show-tracebacks
TWO_FILES := -n 2 --dist loadfile --no-loadscope-reorder
THREE_TESTS := -n 3 --dist load
OTHERS := $(TWO_FILES) $(addprefix --ignore=,$(BROWSER) $(CLOCK))

help:            ## show this help
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 14

setup:           ## install the product into .venv
	@scripts/setup run

setup-dev:       ## install the product, the test tools and a Chromium
	@scripts/setup dev

demo: setup      ## fly through the forest in the browser
	@.venv/bin/aero-viz demo $(ARGS)

test: setup-dev  ## run all checks and tests
	$(PYTHON_BIN) scripts/beside.py check $(PYTHON_BIN) -m pytest $(or $(ARGS),$(OTHERS) $(addprefix --ignore=,$(COMPILING)))
	$(if $(ARGS),,$(PYTHON_BIN) scripts/beside.py test-lowest-files,test-compiling $(MAKE) test-delicate)

test-delicate:
	$(PYTHON_BIN) -m pytest $(SECOND_ATTEMPT) $(BROWSER)
	$(MAKE) -j2 -Otarget test-clock test-lowest-clock

test-clock:
	$(PYTHON_BIN) -m pytest $(SECOND_ATTEMPT) $(THREE_TESTS) $(CLOCK)

test-compiling:
	$(PYTHON_BIN) -m pytest $(TWO_FILES) $(COMPILING)

test-lowest: test-lowest-files $(if $(ARGS),,test-lowest-clock)  ## run the planner's tests with the lowest versions that its wheel allows

test-lowest-files: setup-dev
	@$(PYTHON_BIN) scripts/lowest.py $(or $(ARGS),$(OTHERS))

test-lowest-clock: setup-dev
	@$(PYTHON_BIN) scripts/lowest.py $(THREE_TESTS) $(filter tests/planner/%,$(CLOCK))

# With the usual 16 MB for short-lived objects, Node spends a quarter of the time on collecting garbage.
ROOMY := --max-semi-space-size=256

check: setup-dev  ## check style, types, and the direction of imports
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	NODE_OPTIONS=$(ROOMY) .venv/bin/pyright
	.venv/bin/lint-imports

format: setup-dev  ## apply the project's style to the sources
	.venv/bin/ruff check --fix .
	.venv/bin/ruff format .

bench: setup     ## measure the planner's speed on this machine
	$(PYTHON_BIN) -m aero_planner.benchmark $(ARGS)
	$(PYTHON_BIN) -m benchmarks.guard
	$(PYTHON_BIN) -m benchmarks.floors

fuzz: setup-dev   ## read damaged files of every format for an hour
	@scripts/pins Fuzzing >.venv/fuzzing.txt
	@$(PYTHON_BIN) -m pip install -q --require-hashes --no-deps --only-binary :all: -r .venv/fuzzing.txt \
		|| echo "atheris has no build for this machine: only seeded cases are run"
	PYTHONPATH=tests $(PYTHON_BIN) -m fuzz $(ARGS)

soak: setup-dev   ## fly for two hours before two browsers, one of them slow, and look for growth and freezes
	PYTHONPATH=tests $(PYTHON_BIN) -m soak $(ARGS)

gallery: setup-dev ## take a picture of every view of the page, into build/gallery
	$(PYTHON_BIN) -m tests.gallery $(ARGS)

rig: setup-dev    ## run the tests that fly the onboard node over sockets, in real time
	$(PYTHON_BIN) -m pytest -m realtime tests/rig $(ARGS)

faults: setup-dev ## fly a thousand flights with two or three faults each, in simulated time
	$(PYTHON_BIN) -m tests.rig.fault_flights $(ARGS)

setup-release:
	@scripts/setup release

audit: setup-release  ## look for known vulnerabilities of the pinned packages
	@$(PYTHON_BIN) scripts/audit.py

pin: setup-release  ## update the hashes in constraints.txt after a version was changed
	@$(PYTHON_BIN) scripts/pin.py

release: setup-release  ## build both wheels and their bill of materials (SBOM, CycloneDX) into dist/
	@$(PYTHON_BIN) -m pip wheel -q --disable-pip-version-check --no-deps --no-build-isolation -w dist ./planner .
	@scripts/pins Product Extras | .venv/bin/cyclonedx-py requirements --pyproject pyproject.toml --output-reproducible -o dist/sbom.json -
	@ls dist

clean:           ## remove .venv and caches
	rm -rf .venv .venv-lowest build dist .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +
