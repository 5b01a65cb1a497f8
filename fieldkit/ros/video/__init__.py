"""Video of a synthetic camera over RTP with GStreamer: pipelines, captured packets, columns and checks."""
