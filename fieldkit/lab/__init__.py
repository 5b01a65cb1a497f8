"""A lab that stays up in the background, one per directory: `fieldkit lab`."""
