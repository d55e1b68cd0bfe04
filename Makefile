# Everything runs in .venv, which the first target that needs it makes, with the core (C++20) built into the source tree.
# PYTHON=/path/to/python3.11 chooses the interpreter, EXTRAS=sim,report what is installed; ARGS="..." goes to the command. CXX=clang++,
# GRASP_BUILD_TYPE=Debug, GRASP_ARCH=x86-64-v3, GRASP_SANITIZE=ON and GRASP_ZIG=native build the core once more, in a folder of its own, and test that one.

.DEFAULT_GOAL := help
.PHONY: help install core stubs evaluate bench force test slow docs sanitize check format wheel clean FORCE
BIN := .venv/bin
STAMP := .venv/.installed
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
EDITABLE := $(PIP) --no-build-isolation -C build-dir=build/core -e

# MB on disk and to download: the solver with what builds it, and what each extra adds. tests/test_installs.py measures them.
SIZES := bare=343/87 cli=17/2 sim=383/119 mujoco=102/26 xacro=15/2 live=443/132 layer=905/201 train=1511/370 report=209/39 \
  all=1664/408 mend=2/1 ray=286/90 video=204/77 cvxpy=242/67 bench=46/14 docs=128/31 dev=359/98
IN_ALL := cli sim mujoco xacro live layer train report
comma := ,
EXTRAS := all,bench,dev,docs,mend$(if $(filter slow,$(MAKECMDGOALS)),$(comma)ray)
INSTALLED := $(shell cat $(STAMP) 2>/dev/null)
ifeq ($(MAKECMDGOALS)$(wildcard $(STAMP)),core$(STAMP))
ASKED := # what is there will do
else
ASKED := $(subst $(comma), ,$(EXTRAS))
endif
WANTED := $(sort $(ASKED) $(INSTALLED))
NAMES := $(foreach part,$(SIZES),$(firstword $(subst =, ,$(part))))
UNKNOWN := $(filter-out $(NAMES),$(ASKED))
ifdef UNKNOWN
$(error There is no extra $(UNKNOWN): EXTRAS is a list, with commas, of $(filter-out bare,$(NAMES)))
endif
gigabytes = $(shell printf '%s\n' $(filter $(addsuffix =%,bare $(filter-out $(if $(filter all,$(1)),$(IN_ALL)),$(1))),$(SIZES)) | \
  awk -F '[=/]' '{disk += $$2; load += $$3} END {printf "%.1f GB on disk, %.1f GB of downloads", disk / 1000, load / 1000}')

ZIG := echo "taking a C++ compiler from PyPI" && $(PIP) ziglang

help:
	@echo "make evaluate   compare all starts on every set of cases, roll out the hand: runs/<name>/report.html (two to four minutes)"
	@echo "make bench      timings: ARGS=\"scaling|batch|env|hand_loop|ticks|layer|core [OPTIONS]\", runs/<name>/rows.csv"
	@echo "make force      solvers of grasp forces side by side: python -m benchmarks.force run (ARGS=\"--quick\": within a minute)"
	@echo "make test       the tests (about four minutes)"
	@echo "make slow       the long trials"
	@echo "make docs       these pages as a site, and its tests: build/docs/html (about a minute)"
	@echo "make sanitize   the tests of the core under AddressSanitizer and UBSan"
	@echo "make check      format, lint, types and the stub of the core"
	@echo "make format     format and mend what can be mended"
	@echo "make stubs      write grasp_env/core/_core.pyi anew"
	@echo "make core       only build the core"
	@echo "make install    only the set-up: $(call gigabytes,$(subst $(comma), ,$(EXTRAS))), two to five minutes"
	@echo "                EXTRAS=sim: only the simulated hand, $(call gigabytes,sim); EXTRAS=: only the solver"
	@echo "make wheel      wheels for other machines: dist/ (five minutes for each interpreter; TARGET=aarch64-linux-gnu.2.28: for ARM)"

install: core

# torch goes first and alone: resolved together with other packages a newer build with gigabytes of CUDA may come. Its own index has
# a build without CUDA; where that is out of reach, pip takes what it finds elsewhere. The core is compiled meanwhile.
TORCH := $(if $(filter all layer train,$(WANTED)),\
  $(PIP) --no-deps --retries 1 --extra-index-url https://download.pytorch.org/whl/cpu torch==2.13.0 &&)
$(STAMP): pyproject.toml constraints.txt $(if $(filter-out $(INSTALLED),$(ASKED)),FORCE)
	@echo "Installing into .venv: the solver$(if $(WANTED), and the extras $(WANTED)). In all that takes $(call gigabytes,$(WANTED))"
	@echo "and two to five minutes; make help tells how to install less."
	@$(if $(TORCH),echo "Where download.pytorch.org is out of reach$(comma) PyPI's torch brings 4 GB of CUDA more.")
	@fits() { "$$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' >/dev/null 2>&1; }; \
	python="$(PYTHON)"; \
	if [ -x $(BIN)/python ]; then \
	  fits $(BIN)/python && exit 0; \
	  echo ".venv holds $$($(BIN)/python --version 2>&1); CPython 3.10 to 3.13 is needed: run make clean first." >&2; exit 1; \
	fi; \
	if [ -z "$$python" ]; then \
	  for name in python3.11 python3.10 python3.12 python3.13 python3; do if fits $$name; then python=$$name; break; fi; done; \
	fi; \
	if ! fits "$$python"; then \
	  found=$$("$${python:-python3}" --version 2>&1) || found="none that runs"; \
	  echo "CPython 3.10 to 3.13 is needed; found: $$found." >&2; \
	  echo "Install python3.11 with its venv module, or run: make PYTHON=/path/to/python3.11 $(MAKECMDGOALS)" >&2; exit 1; \
	fi; \
	"$$python" -c 'import os, sysconfig as s; os.stat(s.get_path("include") + "/Python.h")' 2>/dev/null || { \
	  echo "$$python has no Python.h: on Debian or Ubuntu install $$(basename "$$python")-dev, on Fedora $$(basename "$$python")-devel" >&2; exit 1; }; \
	"$$python" -m venv .venv || { \
	  rm -rf .venv; echo "$$python cannot make a virtual environment: on Debian or Ubuntu install $$(basename "$$python")-venv" >&2; exit 1; }
	$(PIP) pip setuptools scikit-build-core nanobind numpy cmake ninja
	@for compiler in $(CXX) c++ g++ clang++; do command -v "$$compiler" >/dev/null && exit 0; done; $(ZIG)
	@$(EDITABLE) . --no-deps & core=$$!; \
	  $(TORCH) $(PIP) --no-build-isolation --only-deps ".[$$(echo $(WANTED) | tr ' ' ,)]"; rest=$$?; wait $$core && exit $$rest
	@echo $(WANTED) >$(STAMP)
FORCE:

# The core in the tree is the one pip built; ninja knows what has changed since. Any other leaves the tree alone.
BUILD := build/core
OPTIONS :=
ifeq ($(origin CXX),command line)
unexport CXX
OPTIONS += -DCMAKE_CXX_COMPILER=$(CXX)
BUILD := $(BUILD)-$(notdir $(CXX))
endif
ifdef GRASP_ARCH
OPTIONS += -DGRASP_ARCH=$(GRASP_ARCH)
BUILD := $(BUILD)-$(GRASP_ARCH)
endif
ifdef GRASP_BUILD_TYPE
OPTIONS += -DCMAKE_BUILD_TYPE=$(GRASP_BUILD_TYPE)
BUILD := $(BUILD)-$(GRASP_BUILD_TYPE)
endif
ifdef GRASP_SANITIZE
OPTIONS += -DGRASP_SANITIZE=$(GRASP_SANITIZE)
BUILD := $(BUILD)-sanitize
endif
ifdef GRASP_ZIG
OPTIONS += -DGRASP_ZIG=$(GRASP_ZIG)
BUILD := $(BUILD)-zig
endif
NINJA := $(BIN)/cmake --build $(BUILD) $(if $(filter core,$(MAKECMDGOALS)),,-- --quiet)
PYTEST := $(BIN)/python -m pytest -n auto --dist loadfile
ifdef OPTIONS
PYTEST := env GRASP_CORE_BUILD=$(BUILD) $$(cat $(BUILD)/environment) $(PYTEST)
endif

core: $(STAMP)
ifdef OPTIONS
	@mkdir -p build
	@[ -z "$(GRASP_ZIG)" ] || $(BIN)/python -c "import ziglang" 2>/dev/null || { $(ZIG); }
	@$(BIN)/cmake -S . -B $(BUILD) -G Ninja -DCMAKE_MAKE_PROGRAM=$(abspath $(BIN)/ninja) -DPython_EXECUTABLE=$(abspath $(BIN)/python) \
	  -DGRASP_CORE_TEST=ON $(OPTIONS) >$(BUILD).log || { cat $(BUILD).log; exit 1; }
	@$(NINJA)
else
	@if [ -f $(BUILD)/build.ninja ]; then $(NINJA); else $(EDITABLE) . --no-deps; fi
endif

FORMAT := find grasp_env/core tests/core benchmarks/force -name '*.[ch]' -o -name '*.[ch]pp' | xargs $(BIN)/clang-format

STUB := $(BIN)/python -m nanobind.stubgen -q -p grasp_env/core/bindings/stub.pat -m grasp_env.core._core -o
stubs: core
	$(STUB) grasp_env/core/_core.pyi

evaluate: core
	$(BIN)/grasp evaluate $(ARGS)

bench: core
	$(BIN)/python -m benchmarks $(ARGS)

force: core
	$(BIN)/python -m benchmarks.force run $(ARGS)

test: core
	$(PYTEST) $(ARGS)

slow: core
	$(PYTEST) -m slow $(ARGS)

docs: core
	$(BIN)/sphinx-build -W --keep-going -n -j auto -q docs build/docs/html $(ARGS)
	$(BIN)/python -m pytest -q -m site tests/test_docs.py

sanitize: # test_package.py and the programs in C++ use no module of Python
	@$(MAKE) --no-print-directory test GRASP_SANITIZE=ON ARGS="tests/core --ignore=tests/core/test_package.py $(ARGS)"

check: core
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(FORMAT) --dry-run -Werror
	$(BIN)/basedpyright
	@$(STUB) build/_core.pyi && diff -u grasp_env/core/_core.pyi build/_core.pyi || { \
	  echo "grasp_env/core/_core.pyi (-) is not what the built module says (+): run make stubs" >&2; exit 1; }

format: $(STAMP)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .
	$(FORMAT) -i

wheel:
	.ci/wheels

clean:
	rm -rf .venv build dist *.egg-info .pytest_cache .ruff_cache grasp_env/core/_core*.so tests/core/_core_test*.so
