"""Judging methods: pairs x methods, tables, pictures, reports."""
