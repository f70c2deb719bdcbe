# The two commands that do all the set-up on a fresh Debian or Ubuntu machine with cargo:
#   make demo    build, then an editing session on the models in assets/; results in out/
#   make test    the whole test suite
.PHONY: help setup demo gallery pages test bench nightly sanitize fuzz deny blender ci clean
.DEFAULT_GOAL := help

CARGO ?= cargo
# rustup puts cargo here; a shell that was open during its installation does not know yet.
export PATH := $(PATH):$(HOME)/.cargo/bin

help:
	@echo 'make demo     build in release mode, edit two models, leave .vdb, .obj and .png in out/'
	@echo 'make gallery  run the recipes of examples/recipes, leave their pictures in docs/images/gallery'
	@echo 'make pages    write the pages of the operators and their pictures, docs/operators'
	@echo 'make test     the whole test suite'
	@echo 'make bench    kernels, every operator beside OpenVDB, cost and memory by size'
	@echo 'make nightly  the test suite in release mode with the slow tests, and without OpenVDB'
	@echo 'make sanitize the bridge to OpenVDB under valgrind and GCC'"'"'s UndefinedBehaviorSanitizer'
	@echo 'make fuzz     the parsers on input guided by coverage, ten minutes each (cargo-fuzz, nightly compiler)'
	@echo 'make deny     licences, origins and known faults of what is linked, by cargo-deny'
	@echo 'make blender  open a level set of this tool in Blender (downloads 374 MB once)'
	@echo 'make ci       everything that .ci/run checks'
	@echo 'make setup    install the system packages that are missing'
	@echo 'make clean    remove target/ and out/'

setup:
	@scripts/setup.sh build

demo: setup
	@scripts/demo.sh

gallery: setup
	@scripts/gallery.sh

pages: setup
	@scripts/pages.sh

test: setup
	$(CARGO) test --locked --no-fail-fast

bench: setup
	$(CARGO) bench --locked --benches

# --tests leaves the documentation's examples out: --include-ignored would run those that are marked as not to be run.
nightly: setup
	PARSER_SECONDS=600 $(CARGO) test --locked --no-fail-fast --release --tests -- --include-ignored
	$(CARGO) test --locked --no-fail-fast --doc
	$(CARGO) test --locked --no-fail-fast --no-default-features --features cli

sanitize: setup
	@scripts/sanitize.sh

fuzz:
	@scripts/fuzz.sh

deny:
	@scripts/deny.sh

blender: setup
	@tests/blender/run.sh

ci:
	@.ci/run

clean:
	$(CARGO) clean
	rm -rf out
