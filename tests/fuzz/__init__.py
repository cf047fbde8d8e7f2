"""Property-based: whatever comes in, either it is understood or one sentence says why not."""
