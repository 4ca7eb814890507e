"""When a pot was turned, learned from the samples: a jump, or a turn that takes its time."""
