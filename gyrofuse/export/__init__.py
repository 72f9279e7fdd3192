"""Fitted models for other software, one module a consumer."""
