"""The medium of a co-simulation: a physics simulator moves emulated robots, and a network carries their packets.

| module | purpose | imports |
| --- | --- | --- |
| `client` | the lab's client: starts the process, and passes it bodies, devices and positions | medium client |
| `cosim_process` | the process: requests of the lab, reading and delivery of packets | medium server, all below |
| `cosim_session` | one run of the coordinator, with its physics and network | cosim, all below |
| `clock` | conversion between simulated time and the monotonic clock | nothing |
| `real_agents` | the agents of the coordinator: packets read from devices, in windows that end in real time | cosim |
| `lab_physics` | the physics simulator, with robots that the lab has placed | steering, velocity flights, federates |
| `steering` | commanded velocities of one robot, and the record of its motion | records in the robot |
| `velocity_flights` | drones in a physics simulator that accepts only velocities | physics |
| `simulators` | builds the physics and the network | cosim, network, radio, physics, velocity flights |

The coordinator advances physics and network together, in windows of simulated time. It is the same as in a
co-simulation without real programs, with the same policies. Only its agents (the robots and their programs) differ:
the end of a window is a deadline of the monotonic clock.
"""
