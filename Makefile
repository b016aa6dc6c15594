# `make help` lists the targets. PYTHON=... picks the interpreter, VENV=... the environment's folder.
SHELL := bash
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test test-extras docs lint format lock bench clean

PYTHON ?= python3.12 python3.13 python3.11 python3
VENV ?= .venv
RUN := $(VENV)/bin/python -m
UV ?= uv
DEMO_OUT ?= runs/demo
EXTRAS :=
# Of the extras, those that `make test` needs; tests of the others are skipped there.
TESTED := dev,hdf5,imitation,kitchen,minari,teleop,video

# A name on the PATH may be a shim that fails, or a Python without venv: only running it tells.
PROBE := import ensurepip, sys, venv; sys.exit(not (3, 11) <= sys.version_info < (3, 14))

# One line for each downloaded package instead of pip's full log; errors go to stderr untouched.
PIP_LINES := /^ *Downloading / && !/\.metadata/ { sub(".*/", "", $$2); print "  " $$0; fflush() } \
	/^Installing collected/ { print "  Unpacking " NF - 3 " packages"; fflush() }

define install
	@echo "Installing represent_jax$(EXTRAS) and its pinned dependencies into $(VENV) (some minutes)"
	@set -o pipefail; $(RUN) pip install --disable-pip-version-check --progress-bar off \
		-c constraints.txt -e '.$(EXTRAS)' | awk '$(PIP_LINES)'
	@echo "Installed."
endef

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-11s %s\n", $$1, $$2 }' Makefile

demo: $(VENV)/.installed ## demonstrations of two imperfect cheetahs -> rewards, policies, a report
	@$(RUN) experiments.represent --env=half_cheetah --preset=quick --out=$(DEMO_OUT) --resume
	@echo "Report: $(DEMO_OUT)/report.html (open it in a browser)"

test: lint ## ruff, then the whole test suite
	@$(RUN) pytest -n 2 --dist loadscope --no-loadscope-reorder

test-extras: $(VENV)/.installed-extras ## tests that need optional libraries: Ray, Stable-Baselines3
	@$(RUN) pytest -m extras

docs: $(VENV)/.installed-docs ## the documentation's site, in site/
	@NO_MKDOCS_2_WARNING=1 $(RUN) mkdocs build --quiet --strict
	@echo "Documentation: site/index.html (open it in a browser)"

lint: $(VENV)/.installed-dev ## ruff check and format check
	@$(RUN) ruff check .
	@$(RUN) ruff format --check .

format: $(VENV)/.installed-dev ## sort imports, apply safe fixes, format
	@$(RUN) ruff check --fix .
	@$(RUN) ruff format .

bench: $(VENV)/.installed ## speed of the engines and of updates on this machine
	@$(RUN) experiments.benchmark

lock: ## write constraints.txt anew with uv, keeping pins; LOCK=--upgrade moves them
	@$(UV) pip compile --quiet --universal --python-version 3.11 --all-extras \
		$(LOCK) --output-file constraints.txt pyproject.toml

clean: ## remove the environment and caches (runs/ stays)
	rm -rf $(VENV) .pytest_cache .ruff_cache build dist site
	find represent_jax experiments tests -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.created:
	@for candidate in $(PYTHON); do \
		if "$$candidate" -c '$(PROBE)' >/dev/null 2>&1; then \
			echo "Creating $(VENV) with $$candidate ($$("$$candidate" --version))"; \
			rm -rf $(VENV) && "$$candidate" -m venv $(VENV) && touch $@ && exit 0; \
		fi; \
	done; \
	echo "No Python 3.11, 3.12 or 3.13 with venv among: $(PYTHON). Set PYTHON=/path/to/python." >&2; \
	exit 1

$(VENV)/.installed: $(VENV)/.created pyproject.toml constraints.txt
	$(install)
	@touch $@

$(VENV)/.installed-dev: EXTRAS := [$(TESTED)]
$(VENV)/.installed-dev: $(VENV)/.created pyproject.toml constraints.txt
	$(install)
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-extras: EXTRAS := [$(TESTED),ray,sb3]
$(VENV)/.installed-extras: $(VENV)/.created pyproject.toml constraints.txt
	$(install)
	@touch $@ $(VENV)/.installed $(VENV)/.installed-dev

$(VENV)/.installed-docs: EXTRAS := [docs]
$(VENV)/.installed-docs: $(VENV)/.created pyproject.toml constraints.txt
	$(install)
	@touch $@ $(VENV)/.installed
