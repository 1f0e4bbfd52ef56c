# `make demo` and `make test` are all that a newcomer needs; each sets up .venv first.
.PHONY: help demo test test-lowest check format bench rig setup setup-dev clean
PYTHON_BIN := .venv/bin/python
ARGS ?=

help:            ## show this help
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 14

setup:           ## install what the product needs into .venv
	@scripts/setup run

setup-dev:       ## the same with the test tools and a Chromium
	@scripts/setup dev

demo: setup      ## fly the forest in the browser
	@.venv/bin/aero-viz demo $(ARGS)

test: setup-dev check  ## all checks and tests
	$(PYTHON_BIN) -m pytest $(ARGS)
	$(if $(ARGS),,@$(MAKE) --no-print-directory test-lowest)

test-lowest: setup-dev  ## the planner's tests with the lowest versions that its wheel allows
	@$(PYTHON_BIN) scripts/lowest.py $(ARGS)

check: setup-dev  ## style, types, and the direction of imports
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/pyright
	.venv/bin/lint-imports

format: setup-dev  ## rewrite the sources in the project's style
	.venv/bin/ruff check --fix .
	.venv/bin/ruff format .

bench: setup     ## planner benchmark on this machine
	$(PYTHON_BIN) -m aero_planner.benchmark $(ARGS)
	$(PYTHON_BIN) -m benchmarks.guard
	$(PYTHON_BIN) -m benchmarks.floors

rig: setup-dev    ## tests that fly the onboard stack over sockets, in real time
	$(PYTHON_BIN) -m pytest -m realtime tests/rig $(ARGS)

clean:           ## remove .venv and caches
	rm -rf .venv .venv-lowest build dist .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +
