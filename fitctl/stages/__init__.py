"""A loop's stages: mirror, siderostat, and the threads that drive them."""
