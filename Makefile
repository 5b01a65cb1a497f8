# `make trial` and `make test` install all that they need.
.DELETE_ON_ERROR:
.PHONY: trial test nightly compile lint rules types pages bench soak fuzz

# If this variable is set, every worker, and every command that a test runs, compiles its imports again.
unexport PYTHONDONTWRITEBYTECODE

FIELDKIT := .venv/bin/fieldkit
# Tests mostly wait, so there are more workers than cores. tests/helpers/priority.py orders the files. Examples of
# hypothesis are the same in each run, so that results are reproducible.
TOGETHER := --numprocesses 10 --dist loadscope --no-loadscope-reorder --hypothesis-profile ci

# Files with tests that run alone. They are named so that pytest does not import all files again.
QUIET = $(shell grep -rl --include='test_*.py' 'mark\.quiet' tests)

trial: ## a trial on emulated robots, shortened to about a minute
	@MAKE_TARGET=$@ .ci/install
	@$(FIELDKIT) trial los 30ft --backend emulated --repeats 3 --record 2s

test: ## all tests except for nightly ones
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/python -m pytest $(TOGETHER) -m "not quiet and not nightly"
	@.venv/bin/python -m pytest -m "quiet and not nightly" $(QUIET)

nightly: ## long tests, each with a small example in `make test`, and new examples of all properties
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/python -m pytest $(TOGETHER) --hypothesis-profile nightly -m "(nightly or hypothesis) and not quiet"
	@.venv/bin/python -m pytest -m "quiet and nightly" $(QUIET)

COLLECTED := .venv/collected.txt

compile: ## compile the test files by collecting them once
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/python -m pytest --collect-only -qq >$(COLLECTED) || { cat $(COLLECTED); exit 1; }

lint: rules types pages ## format, rules, types, docs

rules:
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/ruff format --check .
	@.venv/bin/ruff check .

types: rules
	@.venv/bin/mypy

pages: rules
	@NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --quiet --strict --config-file .ci/mkdocs.yml --site-dir "$(CURDIR)/.venv/site"

soak: ## 1000 power cuts, trials with 200 faults, and 60 faults of moving robots: about 45 minutes
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/python -m tests.e2e.power_cuts --cuts 1000
	@.venv/bin/python -m tests.e2e.chaos --faults 200
	@.venv/bin/python -m tests.e2e.motion_faults --sample 60

FUZZ_MINUTES := 60

fuzz: ## read mutated outputs of robots with every reader for FUZZ_MINUTES; results go to docs/studies/hostile.md
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/python -m tests.fuzz --minutes $(FUZZ_MINUTES)

bench: ## run the benchmarks; copy results with date and machine to docs/benchmarks.md
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/python -m benchmarks.medium
	@.venv/bin/python -m benchmarks.swarm
	@.venv/bin/python -m benchmarks.moves
	@.venv/bin/python -m benchmarks.layers
	@.venv/bin/python -m benchmarks.trial_overhead
	@.venv/bin/python -m benchmarks.startup
	@.venv/bin/python -m benchmarks.pcap
	@.venv/bin/python -m benchmarks.aggregate
	@.venv/bin/python -m benchmarks.archive
	@.venv/bin/python -m benchmarks.ledger
	@.venv/bin/python -m benchmarks.tcp_vs_kernel
	@.venv/bin/python -m benchmarks.radio_vs_ns3
	@.venv/bin/python -m benchmarks.emane
