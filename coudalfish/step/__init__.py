"""One step: options and reports, its attempts, when it is accepted, what is wrong when it is not."""
