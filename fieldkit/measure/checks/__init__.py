"""Contradictions between independent sources of evidence: files, captures, logs and counters."""
