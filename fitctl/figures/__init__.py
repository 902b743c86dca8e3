"""The paper's figures, made from this system."""
