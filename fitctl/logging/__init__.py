"""Records and their schemas, the recorder process, and reading logs back."""
