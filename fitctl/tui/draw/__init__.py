"""Pictures made of characters: pure functions from arrays to lines."""
