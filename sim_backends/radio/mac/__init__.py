"""Medium access control (MAC): contention, frames and their acknowledgements, aggregation, access categories."""
