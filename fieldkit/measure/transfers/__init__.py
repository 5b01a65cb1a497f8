"""From the packets of two captures to losses, delays and times of a transfer."""
