"""Transmitters that are not robots: access points with roaming, neighbouring networks, microwave ovens."""
