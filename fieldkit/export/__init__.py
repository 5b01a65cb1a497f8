"""Export of trials for other programs: tables for pandas and R, timelines for Foxglove, JUnit XML."""
