"""Physical layer (PHY): modulation and coding, airtimes, errors of transmissions due to noise and interference."""
