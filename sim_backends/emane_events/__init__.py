"""Events of the network emulator EMANE (1.5): a run can publish or follow them."""
