"""The link server: one program on a robot that shares a MAVLink connection between the programs of fieldkit there."""
