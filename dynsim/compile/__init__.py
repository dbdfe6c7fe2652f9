"""From a description to tables: model, contacts, references, surfaces."""
