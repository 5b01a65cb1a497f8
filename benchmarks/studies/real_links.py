"""Predicted goodput of links that other people measured: `python -m benchmarks.studies.real_links [--links]`.

The table docs/studies/real-links.csv has the columns of `fieldkit cosim goodput`, and the source of each link. The
links were selected by these rules before the first prediction, and none was removed afterwards:

- The source is public and has, from one test: the goodput of iperf or iperf3 over at least 10 s, as the receiver
  reports it if both ends do; a signal below 0 dBm; and a PHY rate with MCS as `iw` prints it, which includes width,
  streams and guard interval (20 MHz if it prints no width).
- The rate is that of the data's direction: `rx bitrate` of the receiver, or `tx bitrate` of the sender. If both are
  known, the receiver's is used.
- Of repeated tests of an adapter, the newest is used, once per direction, band, standard and width.
- `rate_logged` tells when the rate was logged: byte counters in the source show that it was before, or after the
  data. `bus` is the bus of the adapter; the model has none.

Each link is predicted with its logged mode, and with modes that minstrel_ht selects at the logged signal and width.
"""
