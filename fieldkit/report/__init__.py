"""Reports: one page, and figures, with the results of trials."""
