"""A GigE Vision camera on 127.0.0.1, as its client sees it on the wire."""
