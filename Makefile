# Two commands set everything up: `make demo` and `make test`. `make help` lists the rest.
CARGO ?= cargo
OUT ?= out/demo
MINUTES ?= 30
# Beginnings of the names of tests/tests/browser.rs: they need Chromium, and run one at a time.
BROWSER_TESTS = a_browser_ a_page_ the_page_of_

# Without a desktop Mesa's driver prints errors about a missing one.
ifndef XDG_RUNTIME_DIR
export NODEVICE_SELECT = 1
endif

.PHONY: help setup demo test test-long test-v4l2 test-browser soak fuzz check

help:
	@echo "make demo    install what is missing, build, run the simulated rig, show the report (OUT=$(OUT))"
	@echo "make test    install what is missing, build, run every test"
	@echo "make test-long  the long stability runs (an hour on two cores)"
	@echo "make test-v4l2  camera capture against the kernel's test drivers, in an emulated machine"
	@echo "make test-browser  the web page in Chromium, which it installs"
	@echo "make soak    four plain cameras for MINUTES (30): memory, latency, processor time"
	@echo "make fuzz    damaged input for everything that reads foreign bytes, MINUTES (30) for each"
	@echo "make check   spelling, format, lints and documentation, as CI runs them"
	@echo "make setup   only install what is missing"

setup:
	@scripts/setup.sh

demo: setup
	@echo "demo: building flyrig (the first build takes about 20 minutes on two cores, later ones seconds)"
	$(CARGO) build --release --locked --workspace --bin flyrig
	$(CARGO) run --release --locked -q --bin flyrig -- demo --out $(OUT)

test: setup
	$(CARGO) test --release --locked --workspace

test-long: setup
	$(CARGO) test --release --locked --workspace -- --ignored --nocapture $(foreach test,$(BROWSER_TESTS),--skip $(test))

test-v4l2: setup
	@scripts/test-v4l2.sh

test-browser: setup
	@scripts/setup.sh chromium
	$(CARGO) test --release --locked --workspace --test browser -- --ignored --nocapture --test-threads 1

soak: setup
	$(CARGO) run --release --locked -q --bin flyrig-bench -- capture --minutes $(MINUTES)

fuzz: setup
	$(CARGO) run --release --locked -q --bin fuzz -- --minutes $(MINUTES)

check:
	@scripts/setup.sh codespell
	codespell
	$(CARGO) fmt --all -- --check
	$(CARGO) clippy --release --locked --workspace --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --release --locked --workspace --no-deps
