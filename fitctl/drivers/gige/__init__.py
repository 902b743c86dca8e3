"""GigE Vision cameras: GVCP control, GVSP stream, features from the camera's own GenICam description."""
