"""Rate control: selects the mode of each attempt to send a frame."""
