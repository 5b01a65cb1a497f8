"""A data class that is completed late is the one that `dataclasses` makes at once."""

import dataclasses
import pickle
import subprocess
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import FrozenInstanceError, field
from threading import Barrier, Thread
from typing import Any, ClassVar, cast

import pytest

from fieldkit.core import lazy

Declare = Callable[..., Callable[[type], type]]
NOW, LATER = cast("Declare", dataclasses.dataclass), cast("Declare", lazy.dataclass)
KINDS = pytest.mark.parametrize("declare", [NOW, LATER], ids=["now", "later"])


def declared(declare: Declare, **options: bool) -> Any:  # noqa: ANN401 (a class that no type checker sees)
    @declare(frozen=True, **options)
    class Leg:
        """A leg."""

        kind: ClassVar[str] = "leg"
        length_m: float
        name: str = "first"
        stops: tuple[str, ...] = field(default_factory=lambda: ("end",))

        def __post_init__(self) -> None:
            if self.length_m < 0:
                raise ValueError("a leg leads forward")

    return Leg


@KINDS
def test_what_a_class_gives(declare: Declare) -> None:
    leg = declared(declare)
    one = leg(2.0, name="second")

    assert repr(one).endswith("Leg(length_m=2.0, name='second', stops=('end',))")
    assert one == leg(2.0, "second") != leg(2.0)
    assert len({one, leg(2.0, "second"), leg(2.0)}) == 2
    assert dataclasses.asdict(one) == {"length_m": 2.0, "name": "second", "stops": ("end",)}
    assert dataclasses.replace(one, length_m=3.0) == leg(3.0, "second")
    assert leg.kind == "leg"
    assert not hasattr(leg, "stops")
    with pytest.raises(ValueError, match="forward"):
        leg(-1.0)
    with pytest.raises(TypeError, match=r"missing 1 required positional argument: 'length_m'"):
        leg()
    match one:
        case leg(length_m, name):
            assert (length_m, name) == (2.0, "second")


@KINDS
@pytest.mark.parametrize("name", ["length_m", "new"])
def test_frozen(declare: Declare, name: str) -> None:
    one = declared(declare)(2.0)

    with pytest.raises(FrozenInstanceError, match=f"cannot assign to field '{name}'"):
        setattr(one, name, 3.0)
    with pytest.raises(FrozenInstanceError):
        delattr(one, name)


@KINDS
def test_asked_for_its_fields_first(declare: Declare) -> None:
    assert [one.name for one in dataclasses.fields(declared(declare))] == ["length_m", "name", "stops"]
    assert dataclasses.is_dataclass(declared(declare))


@KINDS
def test_options(declare: Declare) -> None:
    alike, ordered, named = (
        declared(declare, eq=False),
        declared(declare, order=True),
        declared(declare, kw_only=True),
    )

    assert alike(2.0) != alike(2.0)
    assert len({alike(2.0), alike(2.0)}) == 2
    assert max(ordered(1.0), ordered(2.0)) == ordered(2.0)
    assert named(length_m=1.0).length_m == 1.0
    with pytest.raises(TypeError):
        named(1.0)


@KINDS
@pytest.mark.parametrize("heir", [NOW, LATER], ids=["heir now", "heir later"])
def test_inherited(declare: Declare, heir: Declare) -> None:
    """Also by a class that is made before anybody has made an object of its base."""
    leg = declared(declare)

    @heir(frozen=True)
    class Way(leg):  # type: ignore[misc, valid-type]
        way: str = "north"

        @property
        def word(self) -> str:
            return f"{self.way} {super().kind}"

    assert Way(1.0, way="south").word == "south leg"
    assert [one.name for one in dataclasses.fields(Way)] == ["length_m", "name", "stops", "way"]
    assert Way(1.0) != leg(1.0)


@KINDS
def test_own_methods_stay(declare: Declare) -> None:
    @declare(frozen=True)
    class Word:
        text: str

        def __repr__(self) -> str:
            return self.text

        def __eq__(self, other: object) -> bool:
            return isinstance(other, Word) and self.text.lower() == other.text.lower()

        def __hash__(self) -> int:
            return hash(self.text.lower())

    word: Any = Word
    assert repr(word("North")) == "North"
    assert {word("north"), word("North")} == {word("NORTH")}


@KINDS
def test_abstract(declare: Declare) -> None:
    @declare(frozen=True)
    class Shape(ABC):
        size_m: float

        @abstractmethod
        def area(self) -> float: ...

    shape: Any = Shape
    with pytest.raises(TypeError, match="abstract"):
        shape(1.0)


def test_what_is_not_frozen_is_refused() -> None:
    with pytest.raises(TypeError, match=r"use dataclasses\.dataclass"):
        lazy.dataclass(frozen=False)


@lazy.dataclass(frozen=True)
class Kept:
    """For the test of pickles, whose classes must be found by name."""

    number: int


def test_out_of_a_pickle() -> None:
    """The first objects that a process meets were made in another."""
    script = (
        f"import pickle\nfrom {__name__} import Kept\n"
        f"one, same = (pickle.loads({pickle.dumps(Kept(3))!r}) for _ in range(2))\n"
        "assert one == same and hash(one) == hash(same) and repr(one) == 'Kept(number=3)'\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, env={"PYTHONPATH": ":".join(sys.path)})


def test_first_objects_in_many_threads() -> None:
    for _ in range(20):
        leg = declared(LATER)
        begin = Barrier(8)
        made: list[Any] = []

        def make(number: int, begin: Barrier = begin, made: list[Any] = made, leg: Any = leg) -> None:  # noqa: ANN401
            begin.wait()
            made.append(leg(float(number)))

        threads = [Thread(target=make, args=(number,)) for number in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(one.length_m for one in made) == list(range(8))
