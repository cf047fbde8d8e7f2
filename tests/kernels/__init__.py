"""Every Triton kernel against its reference, in Triton's interpreter or on a card."""
