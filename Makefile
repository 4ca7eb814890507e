# Everything that is done to this repository is a target here; `make help` lists them.
# Variables may be overridden on the command line: make test PYTHON=python3.12 PYTEST_ARGS="-k frame"

PYTHON ?= python3
VENV ?= .venv
BUILD ?= build
JOBS ?= $(shell n=$$(nproc 2>/dev/null || echo 2); echo $$((n > 4 ? 4 : n)))
ARGS ?=
PYTEST_ARGS ?=
FUZZ_S ?= 60
FAULTS_N ?= 100000
FAULTS_SEED ?= 0
STRICT_CC ?= gcc clang
CLANG_FORMAT ?= clang-format-14
STRICT_CFLAGS ?= -Wall -Wextra -Wconversion -Wdouble-promotion -Wfloat-equal -pedantic -Werror
STRICT_LEVEL_gcc := -O1
STRICT_LEVEL_clang := -O0

BIN := $(VENV)/bin
ZIG := $(BUILD)/zig
PYTHONS ?= $(foreach version,3.11 3.12 3.13,$(if $(shell python$(version) -c '' 2>/dev/null && echo found),python$(version)))

PRODUCTS := harness/analogrig/_catalogue.py emulator/analogrig_emulator/_engine.so harness/analogrig/_device.so harness/analogrig/bin/analogrig-device \
            harness/analogrig/_device_wide.so harness/analogrig/_device_fixed.so harness/analogrig/bin/analogrig-device-wide harness/analogrig/bin/analogrig-tether harness/analogrig/bin/analogrig-library \
            harness/analogrig/reporting/uPlot.iife.min.js harness/analogrig/reporting/uPlot.min.css
READY := $(PRODUCTS) $(VENV)/.installed $(VENV)/.requirements
NATIVE_SOURCES := $(wildcard emulator/analogrig_emulator/engine/*.[ch] emulator/analogrig_emulator/engine/fast/*.[ch] harness/analogrig/devices/*.c harness/analogrig/include/*.h \
                  estimator_c/*/*.[ch] estimator_c/ports/*/*.[ch] \
                  estimator_c/catalogue/*.dbc estimator_c/catalogue/*.py)
PYTHON_PACKAGES := $(foreach depth,* */* */*/* */*/*/*,$(wildcard harness/$(depth).py emulator/$(depth).py))
PYTHON_SOURCES := emulator harness estimator_c tests setup.py
C_SOURCES := $(wildcard $(foreach folder,emulator/*/engine emulator/*/engine/fast harness/*/* estimator_c/* estimator_c/ports/* estimator_c/ports/*/* tests/* tests/*/src,\
                 $(folder)/*.[ch]))

# The firmware of the boards that QEMU emulates; the M0's runs on that of the M3. Also an STM32F405.
BOARDS := m0 m3 m4 m7 f405
TEXT_FIRMWARE := $(BUILD)/firmware/text_firmware.elf
FIRMWARE := $(BOARDS:%=$(BUILD)/firmware/analogrig-%.elf) $(TEXT_FIRMWARE)
M4F := -mcpu=cortex-m4 -mfloat-abi=hard -mfpu=fpv4-sp-d16
CPU_m0 := -mcpu=cortex-m0 -DFIRMWARE_ID=ANALOGRIG_FIRMWARE_FIRMWARE_ID_BOARD_CHOICE
CPU_m3 := -mcpu=cortex-m3 -DFIRMWARE_ID=ANALOGRIG_FIRMWARE_FIRMWARE_ID_QEMU_M3_CHOICE
CPU_m4 := $(M4F) -DFIRMWARE_ID=ANALOGRIG_FIRMWARE_FIRMWARE_ID_QEMU_M4_CHOICE
CPU_m7 := -mcpu=cortex-m7 -mfloat-abi=hard -mfpu=fpv5-sp-d16 -DFIRMWARE_ID=ANALOGRIG_FIRMWARE_FIRMWARE_ID_QEMU_M7_CHOICE
CPU_f405 := $(M4F) -DFIRMWARE_ID=ANALOGRIG_FIRMWARE_FIRMWARE_ID_BOARD_CHOICE
BOARD_f405 := stm32f405
board = $(addprefix estimator_c/ports/,$(or $(BOARD_$*),mps2))
FIRMWARE_FOLDERS := $(addprefix estimator_c/,core isolation fit device ports/loop ports/cortex_m)
FIRMWARE_CFLAGS := -std=c99 -O2 -mthumb -ffreestanding -ffp-contract=off -ffunction-sections -DNDEBUG \
    -Wall -Wextra -Wdouble-promotion -Werror $(FIRMWARE_FOLDERS:%=-I%) -Iestimator_c/ports/loop/include \
    -I$(BUILD)/generated
FIRMWARE_LDFLAGS := -nostdlib -nostartfiles -Wl,--gc-sections,-z,noexecstack -T estimator_c/ports/cortex_m/image.ld

export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_ROOT_USER_ACTION := ignore
export UV_PYTHON_DOWNLOADS := never
export UV_NATIVE_TLS := 1
# Tests start thousands of processes, several at a time: none compiles the modules again or spreads over all processors.
unexport PYTHONDONTWRITEBYTECODE
export OPENBLAS_NUM_THREADS := 1
# What a user has set for other projects does not reach this one.
unexport PYTHONPATH PYTHONHOME PYTHONSTARTUP PYTHONWARNINGS PYTEST_ADDOPTS PYTEST_PLUGINS

.DELETE_ON_ERROR:
.PHONY: help setup run test test-heavy test-all test-bare test-wheels wheels tools check lint strict layout format docs metrics bench firmware no-firmware \
        cost coverage bit-exact analyze eva mutate mutants foxglove pictures fuzz fuzz-serve lucidac lucidac-next faults hostile defects repositories line-faults packages programs drawn-plays kills \
        can-guest wheel dist lock clean distclean
MAKEFLAGS += --no-builtin-rules

found = $(shell command -v $1 2>/dev/null)

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(READY) ## make the environment in .venv and compile the C; every other target does it when needed

run: $(PRODUCTS) $(VENV)/.installed ## play the thesis's suspension and judge the estimator; ARGS="--seed 7" goes to analogrig run
	@$(BIN)/analogrig run --out $(BUILD)/run $(ARGS)

PYTEST := $(BIN)/pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder
TESTED := $(READY) $(if $(call found,arm-none-eabi-gcc),firmware,no-firmware)

test: check $(TESTED) ## check, then the tests to run before each commit; PYTEST_ARGS="-k frame" goes to pytest
	@$(PYTEST) -m "not heavy" $(PYTEST_ARGS)

test-heavy: $(TESTED) ## the other tests, which take longer
	@$(PYTEST) -m heavy $(PYTEST_ARGS)

test-all: check $(TESTED) ## check, then every test
	@$(PYTEST) $(PYTEST_ARGS)

test-bare: ## make run and make test in a clone, on a PATH that has python3, a C compiler, make, git and coreutils alone
	@$(PYTHON) -m tests.bare

check: $(READY) ## linters, types, the layout of the C, and the C with every warning an error
	@$(MAKE) --no-print-directory -j $(JOBS) lint strict layout

lint: $(READY)
	@$(BIN)/ruff check --quiet --output-format concise $(PYTHON_SOURCES)
	@$(BIN)/ruff format --quiet --check $(PYTHON_SOURCES) || { echo "some files are not formatted: make format"; exit 1; }
	@$(BIN)/mypy --no-error-summary

strict: $(STRICT_CC:%=$(BUILD)/strict/%.ok)

layout:
	@if command -v $(CLANG_FORMAT) >/dev/null; then \
	    $(CLANG_FORMAT) --dry-run --Werror $(C_SOURCES) || { echo "the layout of some C files differs: make format"; exit 1; }; \
	else echo "$(CLANG_FORMAT) is absent, so the layout of the C is not checked: make tools"; fi

format: $(READY) ## lay out the Python sources, and the C with clang-format
	@$(BIN)/ruff check --quiet --select I --fix $(PYTHON_SOURCES)
	@$(BIN)/ruff format $(PYTHON_SOURCES)
	@$(CLANG_FORMAT) -i $(C_SOURCES)

docs: $(READY) ## build the documentation site into build/docs; warnings are errors
	@$(BIN)/python -m sphinx -q -W --keep-going -b html -d $(BUILD)/doctrees harness/docs $(BUILD)/docs
	@echo "$(BUILD)/docs/index.html"

metrics: $(PRODUCTS) ## figures of structure and documents; ARGS="dea2ac6 HEAD" compares commits, ARGS=--arrows lists the imports between folders
	@$(PYTHON) -m tests.metrics $(ARGS)

bench: $(READY) ## measure: one table, and build/bench.json; ARGS="engine" goes to tests.bench
	@$(BIN)/python -m tests.bench $(ARGS)

programs: $(READY) ## 100 random programs, ideal parts beside scipy and real ones beside ngspice; ARGS="COUNT FIRST_SEED" draws others
	@$(BIN)/python -m tests.bench programs $(ARGS)

drawn-plays: $(READY) ## 200 random programs on every emulated rig, 40 seeds each; ARGS="--programs 0:20 --seeds 5" plays fewer
	@$(BIN)/python -m tests.emulator.drawn_plays $(ARGS)

packages: $(READY) ## the manifests of the C estimator under PlatformIO, ESP-IDF and kconfiglib; downloads 60 MB
	@$(BIN)/python -m tests.estimator_c.ecosystems

line-faults: $(READY) ## every fault of a firmware with lines of text at every step, against a scripted one on a pty
	@$(BIN)/python -m tests.soak.line_faults

repositories: $(READY) ## write a repository of each kind by analogrig new from the wheel, and run all its tests
	@ANALOGRIG_ALL=1 $(BIN)/pytest tests/harness/test_new.py $(PYTEST_ARGS)

kills: $(READY) ## end commands by signals at random instants, 40 of each command by each signal; ARGS="5 7" takes 5 with the seed 7
	@$(BIN)/python -m tests.soak.kills $(ARGS)

can-guest: $(READY) $(BUILD)/can_guest/linux ## CAN on real SocketCAN, in a Linux that QEMU emulates; ARGS="-k fd" goes to its pytest
	@$(BIN)/python -m tests.soak.can_guest $(ARGS)

firmware: $(READY) ## the device for Cortex-M0, M3, M4F, M7 and STM32F405, and the text example, into build/firmware; needs gcc-arm-none-eabi
	@$(MAKE) --no-print-directory -j $(JOBS) $(FIRMWARE)
	@arm-none-eabi-size $(FIRMWARE)

$(BUILD)/firmware/analogrig-m0.elf: estimator_c/ports/cortex_m0/float.S

$(BUILD)/firmware/analogrig-%.elf: $(NATIVE_SOURCES) $(wildcard estimator_c/ports/*/*.ld) $(PRODUCTS)
	@mkdir -p $(@D)
	@command -v arm-none-eabi-gcc >/dev/null || \
	    { echo "the firmware needs arm-none-eabi-gcc: apt-get install gcc-arm-none-eabi" >&2; exit 1; }
	@arm-none-eabi-gcc $(FIRMWARE_CFLAGS) $(CPU_$*) $(FIRMWARE_LDFLAGS) -L $(board) $(filter %.S,$^) \
	    $(wildcard $(FIRMWARE_FOLDERS:%=%/*.c) $(board)/*.c) \
	    $(BUILD)/generated/*.c -lgcc -o $@

$(TEXT_FIRMWARE): $(NATIVE_SOURCES) $(wildcard estimator_c/ports/*/*.ld harness/examples/text_firmware/*)
	@$(MAKE) --silent -C harness/examples/text_firmware ESTIMATOR=$(CURDIR)/estimator_c OUT=$(abspath $(@D)) $(abspath $@)

no-firmware:
	@echo "arm-none-eabi-gcc is absent, so no firmware is built: make tools"

tools: ## install the tools of the tests from the operating system (apt, sudo if you are not root), and the guest's kernel
	@$(PYTHON) -m tests.tools install
	@$(MAKE) --no-print-directory $(BUILD)/can_guest/linux

foxglove: $(READY) ## the endpoint for viewers of the live bench under Foxglove's own client, from npm
	@$(BIN)/python -m tests.harness.live.foxglove_npm

pictures: $(READY) ## screenshots of the pages for README and documentation; ARGS="report" makes that one
	@$(BIN)/python -m tests.pictures $(ARGS)

fuzz: $(READY) ## libFuzzer over core, isolation, fit and device, with sanitizers, FUZZ_S seconds each; findings stay in build/fuzz
	@FUZZ_S=$(FUZZ_S) $(BIN)/python -m estimator_c.fuzz.fuzz $(BUILD)/fuzz

fuzz-serve: $(READY) ## hostile clients of analogrig serve, each kind for FUZZ_S seconds; tables of harness/docs/evidence
	@$(BIN)/python -m tests.soak.hostile $(FUZZ_S) 0
	@$(BIN)/python -m tests.soak.hostile_lucidac $(FUZZ_S) 0

lucidac: $(READY) ## the emulated LUCIDAC: 50 circuits in ngspice, streams at the full rate, its op-amps, a million frames; harness/docs/evidence/lucidac.md
	@$(BIN)/python -m tests.bench.soak_lucidac
	@$(BIN)/python -m tests.bench.stream_lucidac
	@$(BIN)/python -m tests.bench.bandwidth_lucidac
	@$(BIN)/python -m tests.soak.hostile_lucidac 0 0 1000000

lucidac-next: $(READY) ## the emulated LUCIDAC under the newest client of its manufacturer, in an environment of its own
	@$(PYTHON) -m venv $(BUILD)/lucidac-next
	@$(BUILD)/lucidac-next/bin/pip install --quiet --upgrade pybrid-computing
	@$(BUILD)/lucidac-next/bin/pip list 2>/dev/null | grep pybrid
	@LUCIDAC_CLIENT=$(abspath $(BUILD)/lucidac-next/bin/python) $(BIN)/pytest -q tests/served/test_lucidac.py -k manufacturers

faults: $(READY) ## every fault of the line at every step, and FAULTS_N runs with faults by chance, from FAULTS_SEED
	@$(BIN)/python -m tests.soak.fault_runs $(FAULTS_N) $(FAULTS_SEED)

hostile: $(READY) ## 5,000 mutated recordings, 2,000 descriptions, 500 logs and every key at absurd values; ARGS="--seed 7" goes to tests.soak.mutated
	@$(BIN)/python -m tests.soak.mutated $(ARGS)

defects: $(READY) ## plant defects in the device, each of which a shipped property must find; the table of tests/properties/README.md
	@$(BIN)/python -m tests.properties.planted

coverage: $(READY) ## lines and branches of core, isolation and fit that their tests reach
	@$(BIN)/python -m estimator_c.evidence.coverage

cost: $(READY) ## cost of the estimator on a Cortex-M: one table, and build/cost.json
	@$(BIN)/python -m estimator_c.evidence.cost

bit-exact: $(READY) ## compare the bits of the estimates of every compiler and every target
	@$(BIN)/python -m estimator_c.evidence.bit_exact

analyze: $(READY) ## static checkers over the C of the device: gcc -fanalyzer, cppcheck with MISRA, clang-tidy
	@$(BIN)/pytest -q tests/estimator_c/test_evidence.py

eva: $(READY) ## Frama-C over the core, all orders of the model: nothing undefined can happen; 4 minutes; ARGS="--jobs 1" takes one processor
	@$(BIN)/python -m estimator_c.evidence.eva $(ARGS)

mutate: $(READY) ## alter the core, which the tests must notice; ARGS="--sample 60" takes so many mutants; build/mutation.json
	@$(BIN)/python -m estimator_c.evidence.mutate $(ARGS)

mutants: $(READY) ## alter core, isolation, device or codec, which a shipped property must fail; ARGS="--sample 640 --seed 2" draws so many; build/mutants.json
	@$(BIN)/python -m tests.properties.mutants $(ARGS)

wheel: $(READY) ## build an sdist, and from it a wheel, into build/dist
	@$(BIN)/python -m build --no-isolation --outdir $(BUILD)/dist
	@rm -rf *.egg-info

dist: ## pack the C estimator of the last commit for CMake, PlatformIO, Zephyr and ESP-IDF: build/dist/est-VERSION.tar.gz
	@mkdir -p $(BUILD)/dist
	@version=$$(awk '/^#define EST_VERSION_/ { printf "%s%s", dot, $$3; dot = "." }' estimator_c/core/est.h) && \
	    git archive --prefix=est-$$version/ --add-file=LICENSE --output=$(BUILD)/dist/est-$$version.tar.gz HEAD:estimator_c \
	        README.md CMakeLists.txt library.json library.properties idf_component.yml core isolation fit src zephyr examples && \
	    echo $(BUILD)/dist/est-$$version.tar.gz

wheels: $(BUILD)/wheels/.made ## build manylinux wheels for x86_64 and aarch64 into build/wheels; downloads zig, 100 MB

test-wheels: wheels ## run the wheels of make wheels, each Python of PYTHONS in an environment of its own
	@ANALOGRIG_WHEELS=$(BUILD)/wheels ANALOGRIG_PYTHONS="$(PYTHONS)" ANALOGRIG_ZIG=$(ZIG)/bin \
	    $(BIN)/pytest tests/test_manylinux.py $(PYTEST_ARGS)

# zig is a C compiler for every platform. Newer releases than 0.14.1 define B115200 otherwise than glibc 2.17 has it, so
# that analogrig-device cannot set up its terminal, which auditwheel does not notice.
$(ZIG)/.made: Makefile
	@rm -rf $(ZIG) && $(PYTHON) -m venv $(ZIG)
	@$(ZIG)/bin/python -m pip install --quiet ziglang==0.14.1 auditwheel==6.8.2
	@touch $@

$(BUILD)/wheels/.made: $(ZIG)/.made $(PRODUCTS) setup.py pyproject.toml $(PYTHON_PACKAGES) $(wildcard fixtures/*/*.toml) | $(VENV)/.requirements
	@rm -rf $(@D) && mkdir -p $(@D)
	@for machine in x86_64 aarch64; do \
	    CC="$(CURDIR)/$(ZIG)/bin/python -m ziglang cc -target $$machine-linux-gnu.2.17" CFLAGS= LDFLAGS=-s \
	    $(BIN)/python -m build --no-isolation --wheel --config-setting=--build-option=--plat-name=manylinux_2_17_$$machine \
	        --outdir $(@D) . >$(@D)/log 2>&1 || { cat $(@D)/log >&2; exit 1; }; \
	done
	@for wheel in $(@D)/*.whl; do $(ZIG)/bin/auditwheel show $$wheel; done
	@rm -rf *.egg-info  # a second description of the package, which pytest would find
	@touch $@

lock: ## resolve requirements.lock again from pyproject.toml; needs uv
	@$(PYTHON) -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"], sep="\n")' | \
	    uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --upgrade --no-annotate \
	        --custom-compile-command "make lock" --extra test --output-file requirements.lock pyproject.toml -

clean: ## remove build products, but not the environment
	rm -rf $(BUILD) *.egg-info harness/analogrig/bin $(PRODUCTS)
	rm -rf .hypothesis .mypy_cache .pytest_cache .ruff_cache

distclean: clean ## remove the environment too
	@if test -e $(VENV)/.made-by-make; then rm -rf $(VENV); fi

# Debian's kernel for the guest: 70 MB are downloaded, and nothing is installed.
$(BUILD)/can_guest/linux: tests/soak/can_guest/linux.py
	@$(PYTHON) -m tests.soak.can_guest.linux

# The environment, in steps: what playing needs, the compiled C, analogrig itself, then what everything else needs. Each
# ends with its stamp, so that one which was interrupted is made again.
# uv takes a tenth of pip's processor time; pip takes over where uv does not find the packages, as by pip's own settings.

UV = $(or $(call found,uv),$(BIN)/uv) pip install --quiet --python $(BIN)/python
LOCKED = $(BIN)/python -m pip install --quiet --require-hashes -r

$(VENV)/.base: requirements.lock
	@command -v $(PYTHON) >/dev/null || { echo "analogrig needs Python ($(PYTHON)): apt-get install python3 python3-venv" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo "analogrig needs Python 3.11 or newer, not $$($(PYTHON) -V 2>&1): make PYTHON=python3.11" >&2; exit 1; }
	@command -v $(firstword $(CC)) >/dev/null || \
	    { echo "analogrig needs a C compiler ($(CC)): apt-get install gcc libc6-dev" >&2; exit 1; }
	@test ! -e $(VENV) || test -e $(VENV)/.made-by-make || \
	    { echo "$(VENV) was not made by this Makefile: remove it, or make VENV=another" >&2; exit 1; }
	@uv --version >/dev/null 2>&1 || $(PYTHON) -c 'import ensurepip' 2>/dev/null || \
	    { echo "$(PYTHON) cannot make environments: apt-get install python3-venv" >&2; exit 1; }
	@echo "making $(VENV)"
	@rm -rf $(VENV) && mkdir $(VENV) && touch $(VENV)/.made-by-make
	@if uv --version >/dev/null 2>&1; then \
	    uv venv --quiet --allow-existing --python "$$(command -v $(PYTHON))" $(VENV); \
	else \
	    $(PYTHON) -m venv $(VENV) && \
	    $(PYTHON) -c 'import re; print(re.search(r"(?ms)^uv==.*?[^\\]$$", open("requirements.lock").read())[0])' >$(VENV)/uv.lock && \
	    { $(LOCKED) $(VENV)/uv.lock || true; }; \
	fi
	@echo "installing what playing needs into $(VENV)"
	@$(PYTHON) -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"], sep="\n")' >$(VENV)/build.txt
	@$(UV) --verify-hashes --constraint requirements.lock -r pyproject.toml -r $(VENV)/build.txt || $(LOCKED) requirements.lock
	@touch $@

$(VENV)/.installed: $(VENV)/.base pyproject.toml setup.py | $(PRODUCTS)
	@echo "installing analogrig into $(VENV)"
	@$(UV) --no-deps --no-build-isolation --editable . || \
	    PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

$(VENV)/.requirements: $(VENV)/.base | $(VENV)/.installed
	@echo "installing what the tests need into $(VENV)"
	@$(UV) --require-hashes -r requirements.lock || $(LOCKED) requirements.lock
	@touch $@

# All products come from one command, whichever is out of date.
$(PRODUCTS) &: $(NATIVE_SOURCES) | $(VENV)/.base
	@echo "compiling the emulator's engine and the device"
	@$(BIN)/python setup.py --quiet build_products --inplace

$(BUILD)/strict/%.ok: $(NATIVE_SOURCES) setup.py Makefile | $(VENV)/.installed
	@mkdir -p $(@D)
	@if command -v $* >/dev/null; then \
	    CC=$* CFLAGS="$(STRICT_LEVEL_$*) $(STRICT_CFLAGS)" $(BIN)/python setup.py --quiet build_products \
	        --build-lib $(@D)/$* --build-temp $(@D)/$* && touch $@; \
	else echo "$* is absent, so the C is not checked with it: make tools"; fi
