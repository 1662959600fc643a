mod commands;
mod contexts;
