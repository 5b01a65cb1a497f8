"""The network federate of ns-3: a C++ program, which is compiled on first use (docs/ns3.md)."""
