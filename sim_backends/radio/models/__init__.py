"""The radio models that simulations and emulated labs use: Wi-Fi in a world, and fixed links."""
