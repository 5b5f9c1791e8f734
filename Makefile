# `make demo` and `make test` need only Python 3.11 to 3.14, git and make. Both
# install into .venv.

# Candidates for the Python of .venv; the first that has a fitting version is
# used. To use another one: `make demo PYTHON=/path/to/python3.12`.
PYTHON = python3.12 python3.11 python3.13 python3.14 python3
PY = .venv/bin/python
INSTALL = $(PY) -m pip install -qq --disable-pip-version-check \
	-c constraints.txt
# dm_control requires labmaze, which has no wheels above 3.12. There, this
# installs the stand-in first, and pip is content.
INSTALL_LABMAZE = if $(PY) -c 'import sys; sys.exit(sys.version_info < (3, 13))'; \
	then $(INSTALL) ./compat/labmaze; fi
WORKERS = 2

# Files with tests that need other extras than `.venv/dev` has.
TESTS_OF_EXTRAS = tests/authors tests/doors/data tests/engine/gl_test.py \
	tests/lab/experiments/offline_test.py \
	tests/doors/browser/supervised_test.py tests/lab/experiments/training_test.py \
	tests/doors tests/launchers/data_test.py

TESTS_OF_CORE = $(addprefix tests/,config entities policies feedback tasks \
	engine evaluation authors/registers_test.py archive_test.py \
	configs_test.py golden_test.py import_rules_test.py suite_test.py)

.PHONY: help demo test test-core lint docs check-release format clean

help:
	@echo 'make demo    train an agent that tampers and its twin, and film both'
	@echo 'make test    run lint, type checks and tests, as before every merge'
	@echo 'make test-core'
	@echo '             run the faster tests of the core only'
	@echo 'make lint    run lint and type checks only'
	@echo 'make docs    build the site in build/site'
	@echo 'make check-release'
	@echo '             run the tests of all extras, and every command and code'
	@echo '             block of README and docs, as before every release'
	@echo 'make format  format the code and apply the fixes of the linter'
	@echo 'make clean   remove .venv, builds and caches, but not results/'

demo: .venv/demo
	.venv/bin/realab demo

test: lint
	$(PY) -m pytest -q -n $(WORKERS) --dist loadfile

test-core: .venv/dev
	$(PY) -m pytest -q -n $(WORKERS) --dist loadfile \
	  -m 'not docs and not camera and not slow' $(TESTS_OF_CORE)

lint: .venv/dev
	$(PY) -m ruff check -q .
	.venv/bin/lint-imports --no-logo --no-cache
	@# Both take a processor each, so they run at once.
	$(PY) -m mypy & types=$$!; $(PY) -m pyink --check -q .; formatted=$$?; \
	  wait $$types && exit $$formatted

docs: .venv/docs
	@echo 'Building the site; this takes a minute or two.'
	$(PY) -m sphinx -j auto -W --keep-going -q -c docs/site . build/site
	@echo 'The site is build/site/docs/site/index.html'

check-release: .venv/extras
	$(PY) -m pip check
	$(PY) -m pytest -q -n $(WORKERS) --dist loadfile $(TESTS_OF_EXTRAS)
	$(PY) -m pytest -q -n $(WORKERS) --dist worksteal -m docs tests/docs

format: .venv/dev
	$(PY) -m ruff check -q --fix .
	$(PY) -m pyink -q .

clean:
	rm -rf .venv build dist compat/*/build *.egg-info .coverage .hypothesis \
		.mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Stamp files: packages are installed again only if a prerequisite changes.
.venv/demo: setup.cfg pyproject.toml constraints.txt | .venv/made
	@echo 'Installing realab_suite into .venv; this takes about a minute.'
	@$(INSTALL_LABMAZE)
	@$(INSTALL) -e '.[agents,report]'
	@touch $@

# Includes all packages of .venv/demo, so it updates both stamps.
.venv/dev: setup.cfg pyproject.toml constraints.txt | .venv/made
	@echo 'Installing realab_suite and its tools into .venv; this takes about a' \
	  'minute.'
	@$(INSTALL_LABMAZE)
	@$(INSTALL) -e '.[agents,report,rpc,gym,dev]'
	@touch .venv/demo $@

.venv/docs: .venv/dev
	@$(INSTALL) -e '.[docs]'
	@touch $@

# All extras fit into one environment. PyTorch may be one without CUDA.
.venv/extras: .venv/docs
	@echo 'Installing all extras, with PyTorch, into .venv; this takes minutes.'
	@$(INSTALL) torch==2.13.0 torchrl==0.14.1 \
		-e '.[cluster,browser,data,sb3]'
	@touch $@

# Debian and Ubuntu ship Python without ensurepip; `venv` then creates an
# incomplete environment. Such a Python is skipped. If no candidate is usable,
# the error message names it.
.venv/made:
	@bare=; for python in $(PYTHON); do \
	  version=$$("$$python" -c \
	    'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null); \
	  case "$$version" in 3.11|3.12|3.13|3.14) ;; *) continue;; esac; \
	  if "$$python" -c 'import ensurepip' 2>/dev/null; then \
	    "$$python" -m venv .venv || exit 1; \
	    case "$$($(PY) -V)" in "Python $$version."*) ;; *) \
	      echo ".venv uses another Python: run 'make clean' first." >&2; \
	      exit 1;; \
	    esac; \
	    touch $@; exit 0; \
	  fi; \
	  bare="$$version"; \
	done; \
	if [ -n "$$bare" ]; then \
	  echo "Python $$bare cannot create virtual environments here: run" \
	    "'sudo apt install python$$bare-venv', then run make again." >&2; \
	else \
	  echo 'realab_suite needs Python 3.11, 3.12, 3.13 or 3.14, but found none' \
	    'among: $(PYTHON). Specify one with' \
	    "'make PYTHON=/path/to/python3.12'." >&2; \
	fi; \
	exit 1
