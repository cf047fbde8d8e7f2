"""Act 3, at the image's size: from each image's decoded maps to its result, with confidence and verdict."""
