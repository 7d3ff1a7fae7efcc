"""Streams of sources: tracked, accumulated, or seen from several places."""
