"""Export of trials to other programs: tables for pandas and R, timelines for Foxglove, JUnit XML."""
