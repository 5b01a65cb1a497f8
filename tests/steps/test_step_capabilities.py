"""Capabilities of steps, which a class has if it defines their methods, even if it does not derive from them."""

import inspect
from collections.abc import Iterator
from functools import partial

import pytest

from fieldkit.backends.protocols import Cast
from fieldkit.core.model import Protocol
from fieldkit.ros.steps.record import RecordStep
from fieldkit.steps import base, capabilities
from fieldkit.steps.base import Step, step_types
from fieldkit.steps.capabilities import CAPABILITIES, HasNeeds, Listens, Prepares, Records, Restarts
from fieldkit.steps.kinds.send import SendStep
from fieldkit.steps.kinds.transfer import TransferStep
from fieldkit.steps.kinds.wait import WaitStep
from fieldkit.steps.nest import Nest
from fieldkit.steps.scene import Need, RecordedFile, Scene
from tests.helpers.idle_testbed import IdleTestbed

MAX_METHODS = 12


class ExternalStep(Step):
    """A kind of another package that derives from no capability."""

    def needs(self, scene: Scene) -> Iterator[Need]:
        return iter(())


class Partial(Step):
    """A kind that defines only a part of a capability."""

    def recordings(self, cast: Cast) -> Iterator[RecordedFile]:
        return iter(())


def public_methods(cls: type) -> list[str]:
    return [name for name, value in vars(cls).items() if not name.startswith("_") and is_method(value)]


def is_method(value: object) -> bool:
    return inspect.isfunction(value) or isinstance(value, classmethod | property)


@pytest.mark.parametrize("cls", [Step, Nest, *CAPABILITIES], ids=lambda cls: cls.__name__)
def test_contract_is_small(cls: type) -> None:
    assert len(public_methods(cls)) <= MAX_METHODS


def test_methods_of_capabilities_are_not_in_the_contract_and_in_one_capability() -> None:
    methods = [name for capability in CAPABILITIES for name in public_methods(capability)]
    assert len(set(methods)) == len(methods)
    assert not set(methods) & set(public_methods(Step))


def test_step_that_defines_the_methods_has_the_capability() -> None:
    step = ExternalStep()
    assert isinstance(step, HasNeeds)
    assert not isinstance(step, Listens | Restarts | Records)


def test_derived_kind_has_the_capabilities_of_its_base_only() -> None:
    """A step class that derives from a capability is not a capability."""
    assert issubclass(SendStep, Listens | Prepares)
    assert not issubclass(ExternalStep, TransferStep)
    assert not issubclass(RecordStep, TransferStep)


def test_the_missing_methods_of_a_partial_capability_are_named() -> None:
    assert capabilities.missing_methods(Partial) == ("records_on", "with_record")
    assert not isinstance(Partial(), Records)
    assert not capabilities.missing_methods(ExternalStep)
    for kind in step_types().values():
        assert capabilities.missing_methods(kind) == ()


def test_step_without_listener_is_run_when_it_has_been_prepared() -> None:
    step, scene = WaitStep.model_validate({"duration": "1s"}), Scene(Protocol.TCP, {}, "f")
    started = base.prepare(step, scene, testbed := IdleTestbed({}))
    assert isinstance(started, partial)
    assert (started.func, started.args) == (step.run, (scene, testbed))
