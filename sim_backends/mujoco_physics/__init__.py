"""Physics federate `mujoco`: robots with wheels and rotors, ground and contacts in MuJoCo (docs/mujoco.md)."""
