pub mod cross_attention;
