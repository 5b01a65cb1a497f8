"""One page, and figures, of what repeats came to."""
