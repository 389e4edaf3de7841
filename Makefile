# make demo   set up, render a small survey, run it, say where the report is
# make test   set up, run the tests, the linter and the type checker
# make docs   build the documentation in build/docs, warnings are errors
# make study  the longer studies        make bench [QUICK=1]  the timings        make mutate  what the tests hold
# On Windows, or without make, see README.md.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: demo test docs study bench mutate setup clean

demo: $(READY)
	$(BIN)/python -m sfm.products.rendering.render datasets/demo/scene.toml build/demo
	$(BIN)/kolinear run datasets/demo/survey.toml --images build/demo --out out/demo

test: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# The site has an environment of its own, so that the program's has only what it needs.
docs:
	@test -x build/docs-env/bin/python || $(PYTHON) -m venv build/docs-env
	@build/docs-env/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt -e '.[docs]'
	build/docs-env/bin/python -m sphinx -E -W --keep-going -n -b html docs build/docs

study: $(READY)
	$(BIN)/python -m pytest -m slow

bench: $(READY)
	$(BIN)/python -m benchmarks.table $(if $(QUICK),--quick)

mutate: $(READY)
	$(BIN)/python -m tests.mutate

setup: $(READY)

# A virtual environment with pinned versions; made anew when the pins or the requirements change.
$(READY): constraints.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed, $(PYTHON) is $$($(PYTHON) --version 2>&1): make PYTHON=python3.12"; exit 2; }
	@echo "Setting up $(VENV) (once) ..."
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install -q --disable-pip-version-check --no-compile -c constraints.txt -e '.[dev]'
	@echo "Compiling the libraries and kernels (once) ..."
	@$(BIN)/python -m compileall -q -j 0 $(VENV)/lib sfm adapters
	@$(BIN)/python -m sfm.cli.warm_up
	@touch $@

clean:
	rm -rf $(VENV) out build *.egg-info .pytest_cache .mypy_cache .ruff_cache
