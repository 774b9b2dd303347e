# Run `make help` for the list of targets.  Every target that needs the
# environment makes sure of it first (tools/setup.sh), which takes no time when
# nothing is missing.

PYTHON := .venv/bin/python

# The processes of an MPI run are the parallelism; threads inside BLAS only get
# in their way, and make timings depend on the machine's load.
export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1

# Packages of the user (~/.local) must not hide Debian's from the environment.
export PYTHONNOUSERSITE = 1

# Open MPI refuses to run as root, which containers do, unless told twice.
export OMPI_ALLOW_RUN_AS_ROOT = 1
export OMPI_ALLOW_RUN_AS_ROOT_CONFIRM = 1

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-slow test-mpi lint bench docs clean distclean

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' Makefile

setup: ## install Debian's packages and make .venv, whatever is missing of them
	@bash tools/setup.sh

demo: setup ## run the manufactured solution and its convergence table, into results/manufactured
	$(PYTHON) demos/manufactured.py --level 4 --out results/manufactured
	$(PYTHON) benchmarks/manufactured.py --levels 1,2,3,4 --presets reference,default --out results/manufactured

test: setup ## run the tests, but for the slow ones
	$(PYTHON) -m pytest -m "not slow"

test-slow: setup ## run the slow tests
	$(PYTHON) -m pytest -m slow

# The cache of pytest is one directory, which two processes must not share.
test-mpi: setup ## run the tests marked mpi on two processes
	mpirun -n 2 --oversubscribe $(PYTHON) -m pytest -p no:cacheprovider -m mpi

lint: setup ## check style and types
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m mypy

bench: setup ## run the benchmarks, into results/benchmarks
	$(PYTHON) benchmarks/manufactured.py --out results/benchmarks

docs: ## write the documentation of the packages into build/docs
	@bash tools/setup.sh docs
	$(PYTHON) -m pdoc --docformat google --math -o build/docs tigar_x shnapr varmint coudalfish

clean: ## remove results, build products and caches; .venv stays
	rm -rf results build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache
	find . -path ./.venv -prune -o -path ./.git -prune -o -type d -name __pycache__ -exec rm -rf {} +

distclean: clean ## remove .venv as well
	rm -rf .venv
