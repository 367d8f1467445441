# Works on a fresh machine with Python >= 3.11 and make. Choose the interpreter with e.g. `make train PYTHON=python3.12`.
PYTHON ?= python3
PIP = .venv/bin/python -m pip install -q --disable-pip-version-check
PEERS_PIP = benchmarks/$(PIP) -r benchmarks/requirements-peers.txt

INTEROP_PIP = tests/interop/$(PIP)
TORCH = torch torchvision

# The newest JAX wants a newer Python than the oldest does: the newest one that starts, of PATH's and of pyenv's.
PYTHONS = $(foreach minor,14 13 12,python3.$(minor) $(wildcard $(HOME)/.pyenv/versions/3.$(minor).*/bin/python)) $(PYTHON)
NEWEST_PYTHON ?= $(shell for python in $(PYTHONS); do if $$python -c "" 2>/dev/null; then echo $$python; break; fi; done)
NEWEST_PIP = $(subst .venv,.venv-newest,$(PIP)) --upgrade --upgrade-strategy eager
# The extra `test` without what keeps MuJoCo back, robosuite and gymnasium-robotics, and without what looks at text only.
NEWEST_EXTRAS = .[minari,tensorboard,video]
NEWEST_TOOLS = pytest pytest-xdist hypothesis ipython

.PHONY: train test test-newest test-versions test-slow test-fuzz test-interop coverage lint docs notebooks check-docs package bench clean

train: .venv/.installed  ## one demonstration, one seed, until it is solved: two or three minutes with the installation
	.venv/bin/hindrl train --env FixedGridPickAndPlace --algo hindrl --demos 1 --seed 2 --stop-at 0.98 --out runs/quickstart --overwrite

test: .venv/.installed-test  ## two files at a time; .pytest_cache keeps what it compiles for the next time
	.venv/bin/python -m pytest --numprocesses auto --maxprocesses 2 --dist loadfile --no-loadscope-reorder

test-newest: .venv-newest/bin/python  ## the fast tests with the newest JAX, Flax, Optax, Chex and MuJoCo, in an environment of its own
	@$(NEWEST_PIP) -e '$(NEWEST_EXTRAS)' $(NEWEST_TOOLS)
	@.venv-newest/bin/python -m pip list --disable-pip-version-check | grep -E '^(jax|jaxlib|flax|optax|chex|mujoco|mujoco-mjx|orbax-checkpoint|numpy) '
	.venv-newest/bin/python -m pytest --numprocesses auto --maxprocesses 2 --dist loadfile --no-loadscope-reorder --ignore tests/project

test-versions: test test-newest  ## both ends of what is supported: the locked versions, and the newest

test-slow: .venv/.installed-test  ## the learning tests, which take minutes each
	.venv/bin/python -m pytest -m slow --ignore tests/fuzz

test-fuzz: .venv/.installed-test  ## 2,000 drawn inputs: must be accepted or refused in one line; FUZZ_SEED=7 draws others
	.venv/bin/python -m pytest -m slow tests/fuzz

test-interop: tests/interop/.venv/.installed  ## robomimic's own tools on our files, and ours on its files
	tests/interop/.venv/bin/python -m pytest tests/interop

coverage: .venv/.installed-test  ## which lines the fast tests run; build/coverage/index.html shows them
	.venv/bin/python -m pytest --numprocesses auto --maxprocesses 2 --dist loadfile --no-loadscope-reorder --cov --cov-report term:skip-covered --cov-report html

lint: .venv/.installed-test
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

docs: .venv/.installed-test  ## site/index.html; a warning is an error
	.venv/bin/python docs/generate.py
	NO_MKDOCS_2_WARNING=1 .venv/bin/python -m mkdocs build --strict

notebooks: .venv/.installed-test  ## runs them at full size and keeps their outputs; needed after a change of their code
	.venv/bin/python docs/execute_notebooks.py

check-docs: docs  ## the site in a browser without a screen, at two widths: what sticks out, leads nowhere or does not load; needs chromium
	.venv/bin/python docs/check_site.py

package: .venv/.installed-test  ## wheel and sdist in dist/, each tried in an environment of its own
	rm -rf build/lib dist
	.venv/bin/python -m build
	tests/try_package.sh $(PYTHON) dist/*.whl
	tests/try_package.sh $(PYTHON) dist/*.tar.gz

bench: .venv/.installed benchmarks/.venv/.installed  ## writes benchmarks/RESULTS.md, about 20 minutes; e.g. make bench BENCH="--only seeds startup"
	.venv/bin/python -m benchmarks.run $(BENCH)

clean:  ## everything that can be made again; results in runs/ stay
	rm -rf .venv benchmarks/.venv tests/interop/.venv .venv-newest build dist site docs/generated .coverage .mypy_cache .pytest_cache .hypothesis .ruff_cache *.egg-info
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

.venv-newest/bin/python:
	@$(NEWEST_PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 12))' || \
	  { echo "the newest JAX needs Python >= 3.12; name one: make test-newest NEWEST_PYTHON=python3.13" >&2; exit 1; }
	@echo "installing the newest versions into .venv-newest ..."
	@$(NEWEST_PYTHON) -m venv .venv-newest

# robomimic is installed without what it asks for: of that, its datasets and scripts need only these, and egl_probe has to be compiled.
tests/interop/.venv/.installed: requirements-test.lock requirements.lock
	@echo "installing robomimic and PyTorch into tests/interop/.venv ..."
	@$(PYTHON) -m venv tests/interop/.venv
	@$(INTEROP_PIP) -r requirements-test.lock
	@$(INTEROP_PIP) $(TORCH) --extra-index-url https://download.pytorch.org/whl/cpu
	@$(INTEROP_PIP) --no-deps robomimic==0.3.0 tensorboardX imageio
	@$(INTEROP_PIP) --no-deps --no-build-isolation -e .
	@touch $@

# torch's CPU build is not on PyPI; pip may know a place that has it, else it is fetched from its makers.
benchmarks/.venv/.installed: benchmarks/requirements-peers.txt
	@echo "installing the benchmark's peers into benchmarks/.venv ..."
	@$(PYTHON) -m venv benchmarks/.venv
	@$(PEERS_PIP) 2>/dev/null || $(PEERS_PIP) --extra-index-url https://download.pytorch.org/whl/cpu
	@touch $@
