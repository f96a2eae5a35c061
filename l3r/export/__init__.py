"""Readers and writers of what a reconstruction leaves behind."""
