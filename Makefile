# Two commands do all the set-up: `make trial` and `make test`.
.DELETE_ON_ERROR:
.PHONY: trial test nightly compile lint bench soak fuzz

# Every worker, and every command that a test runs, would compile all it imports of fieldkit anew.
unexport PYTHONDONTWRITEBYTECODE

FIELDKIT := .venv/bin/fieldkit
# Most of the time is waiting, so there are more workers than cores. Long files come first (tests/conftest.py), and
# examples are the same each time, so that a commit is not judged by luck.
TOGETHER := --numprocesses 8 --dist loadscope --no-loadscope-reorder --hypothesis-profile ci

# Second tries of both parts of `make test` count together. Behind a `=`: before the option is known, a file that is there
# would be taken for tests.
RERUNS := .venv/reruns.txt

trial: ## the main job on emulated robots, shortened to about a minute
	@MAKE_TARGET=$@ .ci/install
	@$(FIELDKIT) trial los 30ft --backend emulated --repeats 3 --record 2s

test: ## all tests but the nightly ones, the emulated ones too
	@MAKE_TARGET=$@ .ci/install --dev
	@rm -f $(RERUNS)
	@.venv/bin/python -m pytest --rerun-log=$(RERUNS) $(TOGETHER) -m "not quiet and not nightly"
	@.venv/bin/python -m pytest --rerun-log=$(RERUNS) -m "quiet and not nightly"

nightly: ## tests that take long: each has a small example in `make test`
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/python -m pytest $(TOGETHER) -m nightly

COLLECTED := .venv/collected.txt

compile: ## what pytest makes of each file of tests when it first collects it
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/python -m pytest --collect-only -qq >$(COLLECTED) || { cat $(COLLECTED); exit 1; }

lint: ## format, rules, types, docs
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/ruff format --check .
	@.venv/bin/ruff check .
	@.venv/bin/mypy
	@NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --quiet --strict --config-file .ci/mkdocs.yml --site-dir "$(CURDIR)/.venv/site"

soak: ## 1000 power cuts, trials among 200 faults, and 60 of the fault matrix of moving robots: about 45 minutes
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/python -m tests.e2e.power_cuts --cuts 1000
	@.venv/bin/python -m tests.e2e.chaos --faults 200
	@.venv/bin/python -m tests.e2e.motion_faults --sample 60

FUZZ_MINUTES := 60

fuzz: ## mutated outputs of robots into every reader: FUZZ_MINUTES of it; results go to docs/studies/hostile.md
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/python -m tests.fuzz --minutes $(FUZZ_MINUTES)

bench: ## the benchmarks; results go to docs/benchmarks.md by hand, with date and machine
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/python -m benchmarks.medium
	@.venv/bin/python -m benchmarks.swarm
	@.venv/bin/python -m benchmarks.moves
	@.venv/bin/python -m benchmarks.layers
	@.venv/bin/python -m benchmarks.trial_overhead
	@.venv/bin/python -m benchmarks.startup
	@.venv/bin/python -m benchmarks.pcap
	@.venv/bin/python -m benchmarks.aggregate
	@.venv/bin/python -m benchmarks.ledger
	@.venv/bin/python -m benchmarks.tcp_vs_kernel
	@.venv/bin/python -m benchmarks.radio_vs_ns3
	@.venv/bin/python -m benchmarks.emane
