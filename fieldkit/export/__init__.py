"""Trials in formats that other programs open: tables for pandas and R, a time line for Foxglove."""
