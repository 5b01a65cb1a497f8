"""Field trials of robots whose radio links are under test.

`fieldkit.load("trials")` returns the repeats, cells and packets of trials as tables; see docs/python-api.md.
"""

TYPE_CHECKING = False  # importing it from `typing` would take longer; type checkers recognize the name
if TYPE_CHECKING:
    from fieldkit.api.trials import Trials, load

__all__ = ["Trials", "__version__", "load"]
__version__ = "0.1.0"

if not TYPE_CHECKING:

    def __getattr__(name):  # noqa: ANN001, ANN202 (the types are declared above)
        """Import `fieldkit.api.trials` on first use, so that commands that do not need it start faster."""
        if name not in {"Trials", "load"}:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from fieldkit.api import trials  # noqa: PLC0415

        return getattr(trials, name)
