"""Events of the network emulator EMANE (1.5): a run publishes them, or follows them."""
