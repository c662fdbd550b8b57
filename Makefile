# `make demo` and `make test` are all a new user needs; both make .venv themselves.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PLAIN := $(VENV)/.installed-plain

OLDEST := .venv-oldest

# Every process would compile all sources of photoplan and of the tests anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test collected test-times test-slow test-nojit test-plain test-oldest lint docs bench clean

$(STAMP): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[test,lint,docs]'
	touch $(STAMP) $(PLAIN)

# The package alone: a third of the packages that tests, checks and documentation bring.
$(PLAIN): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable .
	touch $(PLAIN)

demo: $(PLAIN)
	$(BIN)/photoplan demo demo

# Static checks take as long as the others together: side by side, each with its output in one piece.
SIDE_BY_SIDE := --jobs=2 $(if $(filter output-sync,$(.FEATURES)),--output-sync=target)

# One process more than cores: many tests wait for processes of their own, for locks and for the disk.
PROCESSES = $(shell $(PYTHON) -c "import os; print(min(5, 1 + (os.cpu_count() or 1)))")

test: $(STAMP)
	$(MAKE) $(SIDE_BY_SIDE) lint docs test-nojit collected
	$(BIN)/python -m pytest -n $(PROCESSES) --dist loadfile -m "not slow and not bench"

# In a fresh clone each process of tests would compile the sources of all of them and of what they import, 20 CPU s; here
# it is done once. What cannot be collected is told by the tests themselves.
collected: $(STAMP)
	$(BIN)/python -m pytest -q --collect-only -m "not slow and not bench" >/dev/null || true

# Which tests take the processor's time: folders, files, the dearest tests. Of some only: `make test-times TESTS=tests/cli`.
test-times: $(STAMP)
	PYTHONPATH=tests $(BIN)/python -m pytest -q -n 0 -p tools.cputimes -m "not slow and not bench" $(TESTS)

# What is too long for every change: large inputs, simulations at their full size, new invented cases, kernels without
# numba's inside, and the oldest libraries that pyproject.toml allows.
test-slow: $(STAMP) test-plain test-oldest
	$(BIN)/python -m pytest -m "slow"
	$(BIN)/python -m pytest -m "hypothesis and not bench" --hypothesis-profile search

# The kernels from plain loops, as with a numba that `kernels/numba_internals.py` does not know.
test-plain: $(STAMP)
	PHOTOPLAN_PLAIN_KERNELS=1 NUMBA_CACHE_DIR=$(CURDIR)/build/plain-kernels $(BIN)/python -m pytest -q -m "not slow and not bench" tests/kernels

test-oldest: $(OLDEST)/.installed
	PYTHONPATH=src NUMBA_CACHE_DIR=$(CURDIR)/build/oldest-kernels $(OLDEST)/bin/python -m pytest -m "not slow and not bench" \
		$(addprefix tests/,kernels geometry cameras surfaces plan engine io orientation terrain matching radiometry products)

$(OLDEST)/.installed: pyproject.toml tests/tools/oldest.py
	$(PYTHON) -m venv --clear $(OLDEST)
	$(PYTHON) tests/tools/oldest.py > $(OLDEST)/oldest.txt
	$(OLDEST)/bin/python -m pip install --quiet -r $(OLDEST)/oldest.txt
	touch $@

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
	$(BIN)/python bench/surface_rate.py

clean:
	rm -rf $(VENV) $(OLDEST) demo build docs/_build .pytest_cache .mypy_cache .ruff_cache
