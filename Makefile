# Two commands matter: `make demo` sets up and runs the main job, `make test` sets up and passes the tests.
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: setup demo test check docs proof bench lab clean

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml scripts/setup
	scripts/setup $(VENV)
	touch $@

demo: setup
	PATH="$(CURDIR)/$(BIN):$$PATH" scripts/demo

# The tests start the programs hundreds of times, and each worker imports all tests: with PYTHONDONTWRITEBYTECODE each
# would compile them.
# Six workers on two cores: tests of virtual fleets and of real radios wait for most of their time.
# Pytest rewrites the assertions of each test file and keeps the result: first, and not in each worker at the same time.
test: setup
	$(BIN)/python -m compileall -q meshctl meshlab mesh_sweep udp_mesh
	for half in tests/meshctl "tests --ignore tests/meshctl"; do \
		env -u PYTHONDONTWRITEBYTECODE $(BIN)/pytest -qq --collect-only $$half >/dev/null & \
	done; wait
	scripts/with-test-directory env -u PYTHONDONTWRITEBYTECODE \
		$(BIN)/pytest -n 6 --dist loadgroup --no-loadscope-reorder

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The site, in build/site: warnings are errors, links and anchors are checked, nothing is fetched while it builds.
docs: $(VENV)-docs/.ready
	PYTHONPATH=$(CURDIR) NO_MKDOCS_2_WARNING=1 $(VENV)-docs/bin/mkdocs build --strict
	@echo "docs: open build/site/index.html"

$(VENV)-docs/.ready: pyproject.toml
	test -x $(VENV)-docs/bin/python || python3 -m venv $(VENV)-docs
	HATCH_BUILD_NO_HOOKS=true $(VENV)-docs/bin/pip install --quiet --disable-pip-version-check -e '.[docs]'
	touch $@

# The long proofs: every kill point, hundreds of virtual nodes, hours of virtual time, real roscores, real sudo, missions of
# real radios.
proof: setup
	scripts/setup-ros
	scripts/setup-nats
	$(BIN)/pytest -m proof

# `make bench QUICK=1` runs only the most informative cells. DDS is left out where ROS 2's wheels cannot be installed.
bench: setup
	-scripts/setup-ros2
	test -x $(VENV)-bench/bin/python || python3 -m venv $(VENV)-bench
	HATCH_BUILD_NO_HOOKS=true $(VENV)-bench/bin/pip install --quiet -e '.[dev,bench]'
	$(VENV)-bench/bin/python -m benchmarks $(if $(QUICK),--quick)

# A fleet on the kernel's own radios to practice on; `meshctl lab up` without --real starts in a second and needs no QEMU.
lab: setup
	scripts/setup-lab
	$(BIN)/meshctl lab up --real

clean:
	rm -rf $(VENV) $(VENV)-bench $(VENV)-docs .mypy_cache .ruff_cache .pytest_cache .import_linter_cache dist build
