"""A publisher or subscriber of `/scan` over DDS or Zenoh: `wire_end.py hear|say OVER NETWORK TOPIC FILE`.

NETWORK and TOPIC are JSON. `say` publishes the samples in the file, which are hexadecimal lines, and prints `matched`
when a subscription matches; `hear` prints each received sample.
"""

import json
import sys
import threading
from pathlib import Path

from fieldkit.agent.messaging import middleware
from fieldkit.agent.messaging.middleware import Network, Topic

verb, middleware_name = sys.argv[1:3]
network, topic_description = map(json.loads, sys.argv[3:5])
running = middleware.adapter(middleware_name)(Network(**network))
topic = Topic.from_json(topic_description)
pause = threading.Event()


def show(data: bytes, _: int) -> None:
    sys.stdout.write(data.hex() + "\n")
    sys.stdout.flush()


if verb == "hear":
    running.subscribe(topic, show)
else:
    publisher = running.publisher(topic)
    for sample in Path(sys.argv[5]).read_text(encoding="ascii").split():
        publisher.write(bytes.fromhex(sample))
        pause.wait(0.02)
    while not publisher.matched():
        pause.wait(0.02)
    sys.stdout.write("matched\n")
    sys.stdout.flush()
pause.wait()
