"""Data that crosses a border: one model for each kind of JSON document, form and set of options."""
