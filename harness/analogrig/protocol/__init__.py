"""Our message catalogue: messages, conversation and exchange of samples."""
