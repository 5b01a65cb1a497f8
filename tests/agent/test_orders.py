"""Orders of the laptop are read once and in sequence, and expire; invalid files are ignored."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.agent.orders import Orders

ORDERS = ("stay", "climb", "go", "home")


def test_orders_are_read_once_in_sequence_and_expire(tmp_path: Path) -> None:
    path = tmp_path / "orders"
    orders = Orders(str(path), ORDERS, 60.0)
    assert not orders.poll(), "there is no file"
    for text, order, is_new in (
        ("", "stay", False),
        ("1 climb 30\n", "climb", True),
        ("1 home 30", "climb", False),
        ("3 go 30", "go", True),
        ("2 home 30", "go", False),
        ("4 fly 30", "go", False),
        ("5 home nan", "go", False),
        ("6 home", "go", False),
        ("x home 1", "go", False),
        ("7 go 30", "go", True),
        ("8 home 30", "home", True),
    ):
        path.write_text(text, encoding="ascii")
        assert orders.poll() is is_new, text
        assert orders.order == order, text
        assert not orders.expired
    path.write_text("9 home -1", encoding="ascii")
    assert orders.poll()
    assert orders.expired


def test_first_order_has_a_timeout(tmp_path: Path) -> None:
    assert Orders(str(tmp_path / "orders"), ORDERS, 0.0).expired
    assert not Orders(str(tmp_path / "orders"), ORDERS, 60.0).expired


@given(st.binary(max_size=120))
def test_any_file_content_is_tolerated(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "orders"
    path.write_bytes(data)
    orders = Orders(str(path), ORDERS, 60.0)
    orders.poll()
    assert orders.order in ORDERS
