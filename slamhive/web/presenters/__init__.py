"""From domain values to what pages and JSON show. No request, no database, no file here."""
