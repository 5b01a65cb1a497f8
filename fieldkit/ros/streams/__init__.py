"""Streams of samples over a middleware, and their evidence."""
