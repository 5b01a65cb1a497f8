"""Recommendation of a middleware's configuration from measured trials."""
