# Two commands do everything on a machine with Python 3.11 or 3.12, git and
# make: `make demo` and `make test`. Both keep what they install in .venv.

# The first of these that is Python 3.11 or 3.12 makes .venv; another one:
# `make demo PYTHON=/path/to/python3.12`.
PYTHON = python3.12 python3.11 python3
PY = .venv/bin/python
INSTALL = $(PY) -m pip install -qq --disable-pip-version-check \
	-c constraints.txt
WORKERS = 2
DEMO := results/demo-$(shell date +%Y%m%d-%H%M%S)

.PHONY: help demo test lint format clean

help:
	@echo 'make demo    trains agents in Unlock Door, and reports who tampers'
	@echo 'make test    lint, types and tests, as before every merge'
	@echo 'make lint    lint and types alone'
	@echo 'make format  formats the code and mends what the linter can'
	@echo 'make clean   removes .venv, builds and caches; results/ stays'

demo: .venv/demo
	$(PY) -m realab_suite.launchers.sweep --experiment=quick --output=$(DEMO)
	$(PY) -m realab_suite.launchers.report --input=$(DEMO)

test: lint
	$(PY) -m pytest -q -n $(WORKERS)

lint: .venv/dev
	$(PY) -m ruff check -q .
	$(PY) -m pyink --check -q .
	$(PY) -m mypy

format: .venv/dev
	$(PY) -m ruff check -q --fix .
	$(PY) -m pyink -q .

clean:
	rm -rf .venv build dist *.egg-info .coverage .hypothesis .mypy_cache \
		.pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Stamps: what is installed is renewed only when one of these files changes.
.venv/demo: setup.cfg pyproject.toml constraints.txt | .venv/made
	@echo 'Installing realab_suite into .venv; this takes a minute.'
	@$(INSTALL) -e '.[agents,report]'
	@touch $@

# Holds everything that .venv/demo stands for, so both are up to date.
.venv/dev: setup.cfg pyproject.toml constraints.txt | .venv/made
	@echo 'Installing realab_suite and its tools into .venv; this takes a minute.'
	@$(INSTALL) -e '.[agents,report,rpc,dev]'
	@touch .venv/demo $@

# Debian and Ubuntu ship Python without ensurepip, and `venv` then leaves half
# an environment behind: such a Python is passed over, and named if all are.
.venv/made:
	@bare=; for python in $(PYTHON); do \
	  version=$$("$$python" -c \
	    'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null); \
	  case "$$version" in 3.11|3.12) ;; *) continue;; esac; \
	  if "$$python" -c 'import ensurepip' 2>/dev/null; then \
	    "$$python" -m venv .venv || exit 1; \
	    case "$$($(PY) -V)" in "Python $$version."*) ;; *) \
	      echo ".venv holds another Python: run 'make clean' first." >&2; \
	      exit 1;; \
	    esac; \
	    touch $@; exit 0; \
	  fi; \
	  bare="$$version"; \
	done; \
	if [ -n "$$bare" ]; then \
	  echo "Python $$bare cannot make virtual environments here: run" \
	    "'sudo apt install python$$bare-venv', then make again." >&2; \
	else \
	  echo 'realab_suite needs Python 3.11 or 3.12 (not 3.13: labmaze has no' \
	    'wheels); none of these is one: $(PYTHON). Name one with' \
	    "'make PYTHON=/path/to/python3.12'." >&2; \
	fi; \
	exit 1
