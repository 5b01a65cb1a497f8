"""The link server: a program on a robot that shares a MAVLink connection between the programs of fieldkit there."""
