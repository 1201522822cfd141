"""Is a result to be trusted: goodness of fit, verdict, diagnosis, cross-validation."""
