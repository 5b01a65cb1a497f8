"""Where robots really stood: what told it, as paths over time, and as columns."""
