"""Teaching from photographs, and measuring in photographs."""
