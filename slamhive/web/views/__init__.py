"""One blueprint a page group. Views are thin: read the request, ask the services, hand over to a presenter."""
