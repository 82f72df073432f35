"""What people look at: geometry, pages in a browser, windows, videos, figures."""
