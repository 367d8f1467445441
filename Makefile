# Works on a fresh machine with Python >= 3.11 and make. Choose the interpreter with e.g. `make train PYTHON=python3.12`.
PYTHON ?= python3
PIP = .venv/bin/python -m pip install -q --disable-pip-version-check
PEERS_PIP = benchmarks/$(PIP) -r benchmarks/requirements-peers.txt

.PHONY: train test test-slow lint bench clean

train: .venv/.installed  ## one demonstration, one seed, about a minute
	.venv/bin/hindrl train --env FixedGridPickAndPlace --algo hindrl --demos 1 --seed 2 --out runs/quickstart --overwrite

test: .venv/.installed-test  ## two files at a time; more would need 5 GiB of memory each
	.venv/bin/python -m pytest --numprocesses auto --maxprocesses 2 --dist loadfile

test-slow: .venv/.installed-test  ## the learning tests, which take minutes each
	.venv/bin/python -m pytest -m slow

lint: .venv/.installed-test
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .

bench: .venv/.installed benchmarks/.venv/.installed  ## writes benchmarks/RESULTS.md, about 20 minutes; e.g. make bench BENCH="--only seeds startup"
	.venv/bin/python -m benchmarks.run $(BENCH)

clean:  ## everything that can be made again; results in runs/ stay
	rm -rf .venv benchmarks/.venv build dist .pytest_cache .hypothesis .ruff_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamp files say which lock was installed last, so that a second call installs nothing.
.venv/.installed: requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
	  { echo "hindrl_jax needs Python >= 3.11, which '$(PYTHON)' is not; name one that is, e.g. make train PYTHON=python3.12" >&2; exit 1; }
	@echo "installing into .venv (about a minute) ..."
	@$(PYTHON) -m venv .venv
	@$(PIP) -r requirements.lock
	@$(PIP) --no-deps --no-build-isolation -e .
	@touch $@

.venv/.installed-test: requirements-test.lock .venv/.installed
	@echo "installing the tests' packages into .venv ..."
	@$(PIP) -r requirements-test.lock
	@touch $@

# torch's CPU build is not on PyPI; pip may know a place that has it, else it is fetched from its makers.
benchmarks/.venv/.installed: benchmarks/requirements-peers.txt
	@echo "installing the benchmark's peers into benchmarks/.venv ..."
	@$(PYTHON) -m venv benchmarks/.venv
	@$(PEERS_PIP) 2>/dev/null || $(PEERS_PIP) --extra-index-url https://download.pytorch.org/whl/cpu
	@touch $@
