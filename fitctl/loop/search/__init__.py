"""The search for a star or a beam, and which star on a frame is the loop's own."""
