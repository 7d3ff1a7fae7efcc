"""Sources that follow one another: tracked, accumulated, looked at from several places."""
