"""What each other tool and the lab wrote down: parsers of their files."""
