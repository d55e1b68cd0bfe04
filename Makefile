# Everything runs in .venv, which the first target that needs it makes.
# PYTHON=/path/to/python3.11 chooses the interpreter; ARGS="..." goes to the command.

.DEFAULT_GOAL := help
.PHONY: help install evaluate test slow check format clean
BIN := .venv/bin
STAMP := .venv/.installed

help:
	@echo "make evaluate   compare all starts on every set of cases, roll out the hand: runs/<name>/report.html (about seven minutes)"
	@echo "make test       the tests (about six minutes)"
	@echo "make slow       the long trials"
	@echo "make check      format, lint and types"
	@echo "make format     format and mend what can be mended"
	@echo "make install    only the set-up"

install: $(STAMP)

# torch goes first and alone: resolved together with other packages a newer build with gigabytes of CUDA may come
$(STAMP): pyproject.toml constraints.txt
	@fits() { "$$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] < (3, 12))' >/dev/null 2>&1; }; \
	python="$(PYTHON)"; \
	if [ -x $(BIN)/python ]; then \
	  fits $(BIN)/python && exit 0; \
	  echo ".venv holds $$($(BIN)/python --version 2>&1); CPython 3.10 or 3.11 is needed: run make clean first." >&2; exit 1; \
	fi; \
	if [ -z "$$python" ]; then \
	  for name in python3.11 python3.10 python3; do if fits $$name; then python=$$name; break; fi; done; \
	fi; \
	if ! fits "$$python"; then \
	  found=$$("$${python:-python3}" --version 2>&1) || found="none that runs"; \
	  echo "CPython 3.10 or 3.11 is needed (pybullet has wheels for no later one); found: $$found." >&2; \
	  echo "Install python3.11 with its venv module, or run: make PYTHON=/path/to/python3.11 $(MAKECMDGOALS)" >&2; exit 1; \
	fi; \
	"$$python" -m venv .venv || { \
	  rm -rf .venv; echo "$$python cannot make a virtual environment: on Debian or Ubuntu install $$(basename "$$python")-venv" >&2; exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt pip setuptools
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt torch==2.13.0
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt --no-build-isolation -e ".[dev,video,bench]"
	@touch $(STAMP)

evaluate: $(STAMP)
	$(BIN)/grasp evaluate $(ARGS)

test: $(STAMP)
	$(BIN)/python -m pytest $(ARGS)

slow: $(STAMP)
	$(BIN)/python -m pytest -m slow $(ARGS)

check: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/basedpyright

format: $(STAMP)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf .venv build *.egg-info .pytest_cache .ruff_cache
