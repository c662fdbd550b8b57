# `make demo` and `make test` are all a new user needs; both make .venv themselves.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test test-slow test-nojit lint docs bench clean

$(STAMP): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[test,lint,docs]'
	touch $(STAMP)

demo: $(STAMP)
	$(BIN)/photoplan demo demo

test: lint docs test-nojit
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile -m "not slow and not bench"

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m "slow"

# The kernels once more as plain Python, on small sizes, so that a mistake cannot hide behind the compiler.
test-nojit: $(STAMP)
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest -q -m "not slow and not bench" tests/kernels

lint: $(STAMP)
	$(BIN)/ruff check src tests bench examples
	$(BIN)/ruff format --check src tests bench examples
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(STAMP)
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html

bench: $(STAMP)
	$(BIN)/python -m pip install --quiet --editable '.[bench]'
	$(BIN)/python bench/run.py
	$(BIN)/python bench/overhead.py
	$(BIN)/python bench/startup.py

clean:
	rm -rf $(VENV) demo build docs/_build .pytest_cache .mypy_cache .ruff_cache
