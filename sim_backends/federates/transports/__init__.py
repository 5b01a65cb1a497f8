"""Transports that carry the frames between coordinator and federate; `table` lists them."""
