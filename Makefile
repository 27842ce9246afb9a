# make run: the embedded experiment. make test: the quick tests, in JOBS processes of one thread;
# make test-slow: those marked slow; TESTS chooses files. All set up $(VENV) first.
# make docs: the documentation site, in docs/_build/html; it works without a network.
# make notebooks: the tutorials as executed notebooks, in docs/_build/notebooks.
# make package: sdist and wheel, and the wheel used outside the repository as its users do.
# An environment that already has torch keeps it: make run VENV=/path/to/venv
VENV   ?= .venv
PYTHON ?= python3
TORCH  ?= torch==2.13.0
CONFIG ?= stripmap_damaged
OUT    ?= out/$(notdir $(basename $(CONFIG)))
ARGS   ?=
TESTS  ?= tests
JOBS   ?= 2

# On a machine that others use too, threads that spin while they wait starve those that work.
OMP_WAIT_POLICY ?= PASSIVE
export OMP_WAIT_POLICY

PY    := $(VENV)/bin/python
STAMP := $(VENV)/.torchsar-installed
# Bytecode is kept: otherwise every worker, and every process that a test starts, compiles all files again.
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(PY) -m pytest -n $(JOBS) --dist worksteal

.PHONY: run test test-slow lint docs docs-install notebooks package install clean

run: install
	$(VENV)/bin/torchsar run $(CONFIG) $(ARGS) --out $(OUT)

test: install
	$(PYTEST) -m "not slow" $(TESTS) $(ARGS)

test-slow: install
	$(PYTEST) -m slow $(TESTS) $(ARGS)

lint: install
	$(VENV)/bin/ruff check .
	$(VENV)/bin/pyright --pythonpath $(PY)

docs-install: install
	@$(PY) -c 'import furo, latex2mathml, myst_parser' 2>/dev/null || $(PY) -m pip install -c constraints.txt -e '.[docs]'

docs: docs-install
	$(PY) -m sphinx -W --keep-going -n -q docs docs/_build/html
	@echo 'the documentation is in docs/_build/html/index.html'

notebooks: install
	OMP_NUM_THREADS=1 $(PY) scripts/notebooks.py $(ARGS)

package: install
	VENV=$(VENV) .ci/package

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt Makefile
	@test -x $(PY) || $(PYTHON) -c 'import sys; sys.exit("torchsar needs Python 3.11 or newer, $(PYTHON) is " + sys.version.split()[0] + "; try make PYTHON=python3.11" if sys.version_info < (3, 11) else 0)'
	@test -x $(PY) || $(PYTHON) -m venv $(VENV)
	@if $(PY) -c 'import torch' 2>/dev/null; then \
		echo 'keeping the torch of $(VENV)'; $(PY) -m pip install -e '.[dev]'; \
	else \
		$(PY) -m pip install -c constraints.txt '$(TORCH)' && $(PY) -m pip install -c constraints.txt -e '.[dev]'; \
	fi
	@$(VENV)/bin/torchsar config schema > configs/schema.json  # for editors
	@touch $(STAMP)

clean:
	rm -rf out build dist docs/_build docs/reference/api .venv
