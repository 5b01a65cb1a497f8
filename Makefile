# Two commands do all the set-up: `make trial` and `make test`.
.DELETE_ON_ERROR:
.PHONY: trial test lint bench

FIELDKIT := .venv/bin/fieldkit

trial: ## the main job on emulated robots, shortened to about a minute
	@MAKE_TARGET=$@ .ci/install
	@$(FIELDKIT) trial los 30ft --backend emulated --repeats 3 --record 2s

test: ## all tests, the emulated ones too
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/python -m pytest --numprocesses 3 --dist loadfile

lint: ## format, rules, types, docs
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/ruff format --check .
	@.venv/bin/ruff check .
	@.venv/bin/mypy
	@.venv/bin/mkdocs build --quiet --strict --config-file .ci/mkdocs.yml --site-dir "$(CURDIR)/.venv/site"

bench: ## the benchmarks; results go to docs/benchmarks.md by hand, with date and machine
	@MAKE_TARGET=$@ .ci/install --dev
	@.venv/bin/python -m benchmarks.medium
	@.venv/bin/python -m benchmarks.trial_overhead
