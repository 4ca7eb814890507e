"""Dating of pot changes by the samples: of a jump, and of a turn that takes time."""
