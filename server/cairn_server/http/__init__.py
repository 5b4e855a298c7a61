"""HTTP of the server: the application, its middleware, its routes and its OpenAPI document.

What a route does is decided in the rooms below. Start with `app`.
"""
