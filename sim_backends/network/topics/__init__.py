"""Publish-subscribe as DDS carries it: RTPS, best effort or reliable, with discovery."""
