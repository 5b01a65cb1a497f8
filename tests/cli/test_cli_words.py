"""What events say to people."""

from fieldkit.cli import words
from fieldkit.core.events import RepeatEnded
from fieldkit.core.model import Status


def test_why_a_repeat_is_not_valid_comes_before_what_it_measured() -> None:
    ended = RepeatEnded("udp-07", 1, Status.VOID, "no message", "RTT 1.3 ms", done=0, total=2, left_s=0.0)
    assert "".join(text for text, _ in words.of(ended)) == "  0/2  udp-07  void   no message; RTT 1.3 ms"
