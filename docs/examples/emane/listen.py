"""Print the events of a channel with EMANE's library, to check the events that fieldkit publishes.

Usage: `python3 listen.py 224.1.2.8 45703 lo`.
"""

import sys

from emane.events import EventService, LocationEvent, PathlossEvent

KINDS = {kind.IDENTIFIER: kind for kind in (LocationEvent, PathlossEvent)}

service = EventService((sys.argv[1], int(sys.argv[2]), sys.argv[3]))
while True:
    _, number, events = service.nextEvent()
    for nem, identifier, content in events:
        if identifier in KINDS:
            event = KINDS[identifier]()
            event.restore(content)
            for other, values in event:
                print(number, "to", nem or "all", KINDS[identifier].__name__, other, values)
