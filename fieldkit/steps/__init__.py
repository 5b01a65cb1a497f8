"""Steps of procedures: their contract (`base`), shared parts, and the kinds of step (`kinds`), one module each."""
