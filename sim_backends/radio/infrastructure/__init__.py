"""What is on the air besides the robots: access points with roaming, neighbouring networks, microwave ovens."""
