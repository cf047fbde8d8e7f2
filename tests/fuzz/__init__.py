"""Property-based tests: any input is either understood or rejected with one sentence."""
