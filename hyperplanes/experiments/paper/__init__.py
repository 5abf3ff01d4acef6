"""The paper's experiments as data: tables, published numbers and scales."""
