# Run `make help` for the list of targets.  Every target that needs the
# environment makes sure of it first (tools/setup.sh), which takes no time when
# nothing is missing.

# DOLFINX=wheel takes dolfinx from PyPI, in .venv-wheel, instead of from Debian.
DOLFINX ?= debian
ifeq ($(DOLFINX),wheel)
SETUP := bash tools/setup.sh --wheel
PYTHON := .venv-wheel/bin/python
MPIRUN := .venv-wheel/bin/mpirun
else
SETUP := bash tools/setup.sh
PYTHON := .venv/bin/python
MPIRUN := mpirun --oversubscribe
endif

# Where Debian 13 is kept, for the targets that run on it.
TRIXIE ?= build/trixie

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
.PHONY: help setup check demo test test-slow test-mpi test-trixie test-wheel lint bench docs clean distclean

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-11s %s\n", $$1, $$2 }' Makefile

setup: ## install Debian's packages and make .venv, whatever is missing of them
	@$(SETUP)

check: setup ## test the installation, in a minute, and say in words what is wrong if anything is
	$(PYTHON) -m coudalfish check

demo: setup ## run the fluid-membrane benchmark with its convergence table, a shell, a flow and valves, into results/
	$(PYTHON) demos/manufactured.py --level 4 --overwrite --out results/manufactured
	$(PYTHON) benchmarks/manufactured.py --levels 1,2,3,4 --presets reference,plain,sharp --out results/manufactured
	$(PYTHON) demos/scordelis_lo.py --overwrite --out results/scordelis_lo
	$(PYTHON) demos/lid_driven_cavity.py --degree 2 --overwrite --out results/lid_driven_cavity
	$(PYTHON) demos/valve_2d.py --elements 16 --overwrite --out results/valve_2d
	$(PYTHON) demos/heart_valve.py --resolution 8 --dt 2e-4 --until 0.02 --frames 10 --overwrite --out results/heart_valve

test: setup ## run the tests, but for the slow ones
	$(PYTHON) -m pytest -m "not slow"

test-slow: setup ## run the slow tests
	$(PYTHON) -m pytest -m slow

# The cache of pytest is one directory, which two processes must not share.
test-mpi: setup ## run the tests marked mpi on two processes
	$(MPIRUN) -n 2 $(PYTHON) -m pytest -p no:cacheprovider -m mpi

test-trixie: ## run the tests of the last commit on Debian 13 (dolfinx 0.9), kept in build/trixie; as root
	bash tools/bare_debian.sh --suite trixie --reuse $(TRIXIE) "make test"

test-wheel: ## the same with the wheel of PyPI (dolfinx 0.11)
	bash tools/bare_debian.sh --suite trixie --reuse $(TRIXIE) "make test DOLFINX=wheel"

lint: setup ## check style and types
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m mypy

bench: setup ## run the benchmarks, into results/benchmarks
	$(PYTHON) benchmarks/manufactured.py --out results/benchmarks
	$(PYTHON) benchmarks/scordelis_lo.py --out results/benchmarks/scordelis_lo
	$(PYTHON) benchmarks/contact.py --out results/benchmarks/contact
	$(PYTHON) benchmarks/flow.py --out results/benchmarks/flow
	$(PYTHON) benchmarks/flow_tangents.py --out results/benchmarks/flow_tangents
	$(PYTHON) benchmarks/flow_subscales.py --out results/benchmarks/flow_subscales
	$(PYTHON) benchmarks/flow_extremes.py --out results/benchmarks/flow_extremes
	$(PYTHON) benchmarks/surface.py --out results/benchmarks/surface
	$(PYTHON) benchmarks/surface_space.py --out results/benchmarks/surface_space
	$(PYTHON) benchmarks/immersed_cylinder.py --out results/benchmarks/immersed_cylinder
	$(PYTHON) benchmarks/valve_2d.py --out results/benchmarks/valve_2d
	$(PYTHON) benchmarks/heart_valve.py --out results/benchmarks/heart_valve
	$(PYTHON) benchmarks/valve_extremes.py --out results/benchmarks/valve_extremes

docs: ## write the documentation of the packages into build/docs
	@$(SETUP) docs
	$(PYTHON) -m pdoc --docformat google --math -o build/docs tigar_x shnapr varmint coudalfish

clean: ## remove results, build products and caches; the environments stay
	rm -rf results build/docs build/lib build/bdist.* dist *.egg-info .pytest_cache .ruff_cache .mypy_cache
	find . -path './.venv*' -prune -o -path ./build -prune -o -path ./.git -prune -o -type d -name __pycache__ -exec rm -rf {} +

distclean: clean ## remove the environments as well
	rm -rf .venv .venv-wheel build
