"""Transports that carry the frames between coordinator and federate; `transport_table` lists them."""
