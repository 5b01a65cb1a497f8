"""Programs for robots, beside shell: the standard library and a middleware's own binding, Python 3.8 and later.

Carried there as one file (`fieldkit.remote.agent`), so nothing here imports another room.
"""
