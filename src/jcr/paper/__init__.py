"""The method as published (Zhi, Tang, Zhang and Johnson-Roberson 2024), equation by equation."""
